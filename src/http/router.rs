//! The routes: the table of contents of the API. `openapi.yaml` has the same ones; a test sees to it.

use std::sync::Arc;

use axum::error_handling::HandleErrorLayer;
use axum::extract::DefaultBodyLimit;
use axum::handler::Handler;
use axum::middleware::{from_fn, from_fn_with_state, map_response};
use axum::routing::{MethodFilter, MethodRouter, on};
use axum::{BoxError, Router};
use tower::ServiceBuilder;
use tower::util::MapRequestLayer;
use tower_http::catch_panic::CatchPanicLayer;
use tower_http::request_id::{MakeRequestUuid, PropagateRequestIdLayer, SetRequestIdLayer};
use tower_http::trace::TraceLayer;

use super::access::{self, Rule};
use super::app::App;
use super::client_places;
use super::listen::connection_limit;
use super::pictures::{Of, OfJob};
use super::shares::Places;
use super::{
    algorithms, audit, blobs, calibrations, contract, dashboard, events, exports, jobs, labs,
    layers, me, models, observation, origins, pictures, problems, quality, reference, reports,
    results, samples, session, submissions, system, tiles, tus,
};
use engine::job::{CalibrationId, MeasurementId, ModelId, Sha256};

/// Requests in progress. Two addresses with all their connections do not reach it.
const MOST_REQUESTS: usize = 4096;

/// The largest JSON body.
const JSON_BYTES: usize = 256 * 1024;

#[rustfmt::skip]
pub fn routes() -> Vec<Route> {
    use Route as R;
    vec![
        R::at("/v1/me").get(me::show),
        R::at("/v1/labs").get(labs::list).only(Rule::AllLabs),
        R::at("/v1/labs/{lab}").get(labs::show).patch(labs::change).only(Rule::AllLabs),
        R::at("/v1/blobs").get(blobs::list).query().post(blobs::create).uploads(),
        R::at("/v1/blobs/{sha256}").get(blobs::show).delete(blobs::delete),
        R::at("/v1/blobs/{sha256}/content").get(blobs::content).slow(),
        R::at("/v1/uploads").get(tus::list).query().post(tus::create).options(tus::options).tus(),
        R::at("/v1/uploads/{upload}").head(tus::show).patch(tus::patch).delete(tus::delete).tus(),
        R::at("/v1/calibrations").get(calibrations::list).query().post(submissions::create::<CalibrationId>).slow(),
        R::at("/v1/calibrations/{calibration}").get(submissions::show::<CalibrationId>).patch(submissions::rename::<CalibrationId>).delete(submissions::delete::<CalibrationId>),
        R::at("/v1/calibrations/{calibration}/masks").get(calibrations::masks).slow(),
        R::at("/v1/calibrations/{calibration}/report").get(reports::json),
        R::at("/v1/measurements").get(submissions::list::<MeasurementId>).query().post(submissions::create::<MeasurementId>).slow(),
        R::at("/v1/measurements/{measurement}").get(submissions::show::<MeasurementId>).patch(submissions::rename::<MeasurementId>).delete(submissions::delete::<MeasurementId>),
        R::at("/v1/models").get(submissions::list::<ModelId>).query().post(models::create).slow(),
        R::at("/v1/models/{model}").get(submissions::show::<ModelId>).patch(submissions::rename::<ModelId>).delete(submissions::delete::<ModelId>),
        R::at("/v1/algorithms").get(algorithms::list),
        R::at("/v1/jobs").get(jobs::list).query().post(jobs::create).only(Rule::AcrossLabs),
        R::at("/v1/samples").post(samples::create),
        R::at("/v1/jobs/estimate").post(jobs::estimate).changes_nothing(),
        R::at("/v1/jobs/{job}").get(jobs::show).patch(jobs::change).delete(jobs::delete),
        R::at("/v1/jobs/{job}/cancel").post(jobs::cancel),
        R::at("/v1/jobs/{job}/retry").post(jobs::retry),
        R::at("/v1/jobs/{job}/snapshots").get(results::list).query(),
        R::at("/v1/jobs/{job}/snapshots/{snapshot}").get(results::snapshot),
        R::at("/v1/jobs/{job}/snapshots/{snapshot}/quality").get(quality::show).query().slow(),
        R::at("/v1/jobs/{job}/snapshots/{snapshot}/exports/{format}").get(exports::snapshot_file).query().slow(),
        R::at("/v1/jobs/{job}/snapshots/{snapshot}/exports/{format}/{*path}").get(exports::part).slow(),
        R::at("/v1/jobs/{job}/exports").post(exports::create),
        R::at("/v1/jobs/{job}/exports/{format}").get(exports::job_file).slow(),
        R::at("/v1/jobs/{job}/exports/{format}/{*path}").get(exports::part).slow(),
        R::at("/v1/events").get(events::listen).slow(),
        R::at("/v1/system").get(system::show).only(Rule::Admin),
        R::at("/livez").get(system::live).only(Rule::Public),
        R::at("/readyz").get(system::ready).only(Rule::Public),
        R::at("/metrics").get(system::metrics).only(Rule::Admin),

        // Pages and what only they use: no part of the API that clients rely on.
        R::at("/").get(dashboard::page).only(Rule::Public),
        R::at("/dashboard/{file}").get(dashboard::file).only(Rule::Public),
        R::at("/docs").get(reference::page).only(Rule::Public),
        R::at("/docs/{file}").get(reference::file).only(Rule::Public),
        R::at("/problems/{code}").get(problems::show).only(Rule::Public),
        R::at("/openapi.yaml").get(contract::yaml).only(Rule::Public),
        R::at("/openapi.json").get(contract::json).only(Rule::Public),
        R::at("/view/session").post(session::create).delete(session::delete).query().only(Rule::Own),
        R::at("/view/blobs/{sha256}/pictures/{picture}").get(pictures::preview::<Of<Sha256>>).query().slow(),
        R::at("/view/calibrations/{calibration}/report.html").get(reports::html),
        R::at("/view/calibrations/{calibration}/maps/{map}").get(reports::map),
        R::at("/view/calibrations/{calibration}/pictures/{picture}").get(pictures::preview::<Of<CalibrationId>>).query().slow(),
        R::at("/view/calibrations/{calibration}/pictures/{picture}/spread").get(pictures::spread::<Of<CalibrationId>>).slow(),
        R::at("/view/calibrations/{calibration}/pictures/{picture}/tiles/{level}/{row}/{column}").get(pictures::tile::<Of<CalibrationId>>).query().slow(),
        R::at("/view/calibrations/{calibration}/pictures/{picture}/values/{level}/{row}/{column}").get(pictures::values::<Of<CalibrationId>>).slow(),
        R::at("/view/measurements/{measurement}/pictures/{picture}").get(pictures::preview::<Of<MeasurementId>>).query().slow(),
        R::at("/view/measurements/{measurement}/pictures/{picture}/spread").get(pictures::spread::<Of<MeasurementId>>).slow(),
        R::at("/view/measurements/{measurement}/pictures/{picture}/tiles/{level}/{row}/{column}").get(pictures::tile::<Of<MeasurementId>>).query().slow(),
        R::at("/view/measurements/{measurement}/pictures/{picture}/values/{level}/{row}/{column}").get(pictures::values::<Of<MeasurementId>>).slow(),
        R::at("/view/jobs/{job}/snapshots/{snapshot}/pictures/{picture}").get(pictures::preview::<OfJob>).query().slow(),
        R::at("/view/jobs/{job}/snapshots/{snapshot}/pictures/{picture}/spread").get(pictures::spread::<OfJob>).slow(),
        R::at("/view/jobs/{job}/snapshots/{snapshot}/pictures/{picture}/tiles/{level}/{row}/{column}").get(pictures::tile::<OfJob>).query().slow(),
        R::at("/view/jobs/{job}/snapshots/{snapshot}/pictures/{picture}/values/{level}/{row}/{column}").get(pictures::values::<OfJob>).slow(),
        R::at("/view/jobs/{job}/snapshots/{snapshot}/tiles").get(tiles::list),
        R::at("/view/jobs/{job}/snapshots/{snapshot}/tiles/{tile}/history").get(tiles::history),
    ]
}

/// The router with all routes and layers.
pub fn router(app: App) -> Router {
    let seconds = app.settings.request_seconds;
    let late = HandleErrorLayer::new(move |_: BoxError| async move { layers::timed_out(seconds) });
    let timeout = ServiceBuilder::new().layer(late).timeout(app.settings.request_time());
    let close = map_response(layers::close_after_refusal);
    let shedding = layers::shedding(MOST_REQUESTS);
    let sites = Arc::new(access::Sites::new(&app.settings, app.audit.clone()));
    let mut router = Router::new();
    for route in routes() {
        let (store, revocations) = (app.store.clone(), app.revocations.clone());
        let guard =
            from_fn_with_state((store, sites.clone(), revocations, route.rule), access::guard);
        let handlers =
            if route.slow { route.handlers } else { route.handlers.layer(timeout.clone()) };
        let reserve = from_fn_with_state(app.store.clone(), layers::delete_with_reserve);
        let record = from_fn_with_state((app.audit.clone(), route.path), audit::record);
        let closed = from_fn_with_state(route.queries, layers::closed_query);
        // The guard takes `lab` out of the query. Browsers and probes add parameters to the address of a public route.
        let handlers =
            if route.rule == Rule::Public { handlers } else { handlers.route_layer(closed) };
        let handlers = handlers.route_layer(reserve).route_layer(guard);
        let handlers = if route.is_pure { handlers } else { handlers.route_layer(record) };
        let handlers = if route.uploads { handlers.layer(close.clone()) } else { handlers };
        // Probes are answered under load, too.
        let is_probe = route.rule == Rule::Public;
        let handlers = if is_probe { handlers } else { handlers.layer(shedding.clone()) };
        router = router.route(route.path, handlers);
    }
    let cors = origins::cors(&app.settings.cors_origins);
    let [sniffing, referrer, framing] = layers::restrictions();
    let trace = TraceLayer::new_for_http()
        .make_span_with(observation::span)
        .on_request(())
        .on_response(())
        .on_failure(());
    let observation = ServiceBuilder::new()
        .layer(MapRequestLayer::new(observation::without_odd_id))
        .layer(SetRequestIdLayer::x_request_id(MakeRequestUuid))
        .layer(PropagateRequestIdLayer::x_request_id())
        .layer(trace)
        .layer(from_fn(observation::observe));
    let router = router
        .fallback(layers::not_found)
        .method_not_allowed_fallback(layers::method_not_allowed)
        .layer(DefaultBodyLimit::max(JSON_BYTES))
        .layer(CatchPanicLayer::custom(layers::panicked))
        .layer(from_fn_with_state(Places::for_clients(connection_limit()), client_places::limit))
        .layer(from_fn(layers::one_host))
        .layer(from_fn(layers::relative_references))
        .layer(ServiceBuilder::new().layer(sniffing).layer(referrer).layer(framing))
        .layer(layers::compression())
        .layer(from_fn(layers::encoded_tags))
        .layer(observation)
        .with_state(app);
    // Around the routes: what changes the method or the path of a request.
    let rewritten = ServiceBuilder::new().layer(MapRequestLayer::new(tus::rewrite)).service(router);
    match cors {
        Some(cors) => Router::new().fallback_service(origins::with_cors(cors, rewritten)),
        None => Router::new().fallback_service(rewritten),
    }
}

/// A path with its methods and handlers.
#[derive(Debug)]
pub struct Route {
    /// The path, with parameters in braces.
    pub path: &'static str,
    /// The methods as they stand in the contract, in lower case.
    pub methods: Vec<&'static str>,
    handlers: MethodRouter<App>,
    /// The methods whose handlers read the query.
    queries: Vec<&'static str>,
    pub(super) rule: Rule,
    slow: bool,
    uploads: bool,
    is_pure: bool,
}

impl Route {
    fn at(path: &'static str) -> Self {
        Self {
            path,
            methods: Vec::new(),
            handlers: MethodRouter::new(),
            queries: Vec::new(),
            rule: Rule::ByMethod,
            slow: false,
            uploads: false,
            is_pure: false,
        }
    }

    fn method<H, T>(mut self, name: &'static str, filter: MethodFilter, handler: H) -> Self
    where
        H: Handler<T, App>,
        T: 'static,
    {
        self.methods.push(name);
        self.handlers = self.handlers.merge(on(filter, handler));
        self
    }

    /// GET, and HEAD with it.
    fn get<H: Handler<T, App>, T: 'static>(self, handler: H) -> Self {
        self.method("get", MethodFilter::GET, handler)
    }

    fn post<H: Handler<T, App>, T: 'static>(self, handler: H) -> Self {
        self.method("post", MethodFilter::POST, handler)
    }

    fn patch<H: Handler<T, App>, T: 'static>(self, handler: H) -> Self {
        self.method("patch", MethodFilter::PATCH, handler)
    }

    /// HEAD where there is no GET.
    fn head<H: Handler<T, App>, T: 'static>(self, handler: H) -> Self {
        self.method("head", MethodFilter::HEAD, handler)
    }

    fn options<H: Handler<T, App>, T: 'static>(self, handler: H) -> Self {
        self.method("options", MethodFilter::OPTIONS, handler)
    }

    fn delete<H: Handler<T, App>, T: 'static>(self, handler: H) -> Self {
        self.method("delete", MethodFilter::DELETE, handler)
    }

    /// The handlers up to here read the query. Any query that another handler gets is refused.
    fn query(mut self) -> Self {
        self.queries.clone_from(&self.methods);
        self
    }

    /// For others than those who read or submit data of a lab.
    fn only(mut self, rule: Rule) -> Self {
        self.rule = rule;
        self
    }

    /// No method changes anything, so requests are not recorded in the audit log.
    fn changes_nothing(mut self) -> Self {
        self.is_pure = true;
        self
    }

    /// Without a limit on the time of the answer: the check of a large file takes minutes, so does reading it whole
    /// before it is handed out, and events never end.
    fn slow(mut self) -> Self {
        self.slow = true;
        self
    }

    /// As [`Self::uploads`], in the version of tus that we speak.
    fn tus(mut self) -> Self {
        self.handlers = self.handlers.route_layer(from_fn(tus::version));
        self.uploads()
    }

    /// As [`Self::slow`], and with uploads' own limits instead of that of JSON bodies.
    fn uploads(mut self) -> Self {
        self.handlers = self.handlers.layer(DefaultBodyLimit::disable());
        self.uploads = true;
        self.slow()
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use super::routes;

    #[test]
    fn the_contract_has_all_routes_and_no_others() {
        let contract: serde_yaml_ng::Value =
            serde_yaml_ng::from_str(include_str!("../../openapi.yaml")).unwrap();
        let mut documented = BTreeSet::new();
        for (path, item) in contract["paths"].as_mapping().unwrap() {
            for (key, _) in item.as_mapping().unwrap() {
                let (path, key) = (path.as_str().unwrap(), key.as_str().unwrap());
                // A route for GET also answers HEAD.
                let with_get = key == "head" && item.get("get").is_some();
                if key != "parameters" && key != "summary" && !with_get {
                    // OpenAPI has no sign for the rest of a path.
                    documented.insert(format!("{key} {path}").replace("{path}", "{*path}"));
                }
            }
        }
        let routes = routes();
        let served = routes.iter().flat_map(|route| {
            route.methods.iter().map(|method| format!("{method} {}", route.path))
        });
        assert_eq!(served.collect::<BTreeSet<_>>(), documented);
    }
}
