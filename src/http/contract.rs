//! The contract: `openapi.yaml`, which is assembled from the prose in `contract.yaml` and from the routes.
//!
//! The prose is OpenAPI with abbreviations. A string in the place of a parameter, response, header or schema names a
//! component. `json: NAME` and `page: NAME` are the body of an answer, `body: NAME` and `example` that of a request.
//! `conditional`, `ranges` and `wait` add the parameters, headers and answers that all such operations share. `untagged`
//! marks a POST whose answer is no resource. The rule of a route adds the parameter `lab` and the common errors.

use std::sync::LazyLock;

use axum::response::Response;

use super::asset::Asset;
use super::context::RequestContext;
use super::error::Result;

const YAML: &str = include_str!("../../openapi.yaml");

static AS_YAML: LazyLock<Asset> = LazyLock::new(|| Asset::new("application/yaml", YAML));

static AS_JSON: LazyLock<Asset> = LazyLock::new(|| {
    // A test reads the same text. If it failed here, the document would be empty.
    let document: serde_json::Value = serde_yaml_ng::from_str(YAML).unwrap_or_default();
    Asset::new("application/json", document.to_string().into_bytes())
});

/// `GET /openapi.yaml`.
pub(super) async fn yaml(request: RequestContext) -> Result<Response> {
    AS_YAML.answer(&request.headers)
}

/// `GET /openapi.json`.
pub(super) async fn json(request: RequestContext) -> Result<Response> {
    AS_JSON.answer(&request.headers)
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use schemars::generate::SchemaSettings;
    use serde_json::{Value as Json, json};
    use serde_yaml_ng::{Mapping, Value};

    use super::super::access::Rule;
    use super::super::calibrations::CalibrationBody;
    use super::super::error::Problem;
    use super::super::jobs::JobBody;
    use super::super::measurements::MeasurementBody;
    use super::super::models::ModelBody;
    use super::super::page::PageBody;
    use super::super::pictures::SpreadBody;
    use super::super::router::routes;
    use super::super::{
        algorithms, events, exports, jobs, labs, me, page, quality, results, samples, session,
        system, tiles, tus,
    };
    use super::YAML;

    use engine::job::{
        CalibrationReport, CalibrationRequest, JobRequest, MeasurementRequest, ModelRequest,
    };
    use engine::pipeline::manifest::{JobManifest, Manifest};
    use store::{Blob, BlobRow, TileHistory};

    const PROSE: &str = include_str!("contract.yaml");
    const METHODS: [&str; 6] = ["get", "head", "post", "patch", "delete", "options"];

    fn value<T: serde::Serialize>(content: T) -> Value {
        serde_yaml_ng::to_value(content).unwrap()
    }

    fn reference(kind: &str, name: &str) -> Value {
        value(BTreeMap::from([("$ref", format!("#/components/{kind}/{name}"))]))
    }

    /// Replaces a string by the component that it names.
    fn expand(kind: &str, content: Value) -> Value {
        match content {
            Value::String(name) => reference(kind, &name),
            Value::Mapping(map) => Value::Mapping(schemas(map)),
            other => other,
        }
    }

    /// Expands the names of schemas inside.
    fn schemas(map: Mapping) -> Mapping {
        let expanded = map.into_iter().map(|(key, content)| {
            let content = match content {
                Value::String(_) if key == "schema" => expand("schemas", content),
                Value::Mapping(map) => Value::Mapping(schemas(map)),
                other => other,
            };
            (key, content)
        });
        expanded.collect()
    }

    fn media(kind: &str, schema: Value) -> Value {
        value(BTreeMap::from([(kind, BTreeMap::from([("schema", schema)]))]))
    }

    fn map<'a>(parent: &'a mut Mapping, key: &str) -> &'a mut Mapping {
        parent.entry(key.into()).or_insert_with(|| Value::Mapping(Mapping::new()));
        parent[key].as_mapping_mut().unwrap()
    }

    fn response(content: Value) -> Value {
        let Value::Mapping(mut answer) = content else { return expand("responses", content) };
        if let Some(headers) = answer.get_mut("headers").and_then(Value::as_mapping_mut) {
            for header in headers.values_mut() {
                *header = expand("headers", std::mem::take(header));
            }
        }
        if let Some(body) = answer.remove("json") {
            answer.insert("content".into(), media("application/json", expand("schemas", body)));
        }
        if let Some(page) = answer.remove("page") {
            let schema = reference("schemas", &format!("{}Page", page.as_str().unwrap()));
            answer.insert("content".into(), media("application/json", schema));
            map(&mut answer, "headers").insert("Link".into(), reference("headers", "Link"));
        }
        Value::Mapping(schemas(answer))
    }

    /// An operation without abbreviations.
    fn operation(mut prose: Mapping, (method, path, rule): (&str, &str, Rule)) -> Value {
        let mut flag = |name: &str| prose.remove(name).is_some();
        let (conditional, ranges, wait) = (flag("conditional"), flag("ranges"), flag("wait"));
        let untagged = flag("untagged");
        let guarded = rule != Rule::Public;
        let mut parameters: Vec<Value> = match prose.remove("parameters") {
            Some(Value::Sequence(list)) => list,
            _ => Vec::new(),
        };
        let mut add = |names: &[&str]| parameters.extend(names.iter().map(|&name| value(name)));
        let answers = prose.remove("responses").unwrap();
        let Value::Mapping(answers) = answers else { panic!("{path} has no answers") };
        let mut answers: BTreeMap<String, Value> = answers
            .into_iter()
            .map(|(status, answer)| (status.as_str().unwrap().to_owned(), response(answer)))
            .collect();
        let is_picture = answers.get("200") == Some(&reference("responses", "Picture"));
        let mut may = |names: &[(&str, &str)]| {
            for (status, name) in names {
                answers.entry((*status).to_owned()).or_insert_with(|| reference("responses", name));
            }
        };
        may(&[("503", "Unavailable")]);
        if guarded {
            may(&[("400", "BadRequest"), ("401", "Unauthorized"), ("403", "Forbidden")]);
            may(&[("404", "NotFound"), ("429", "RateLimited"), ("500", "Internal")]);
        }
        if is_picture {
            may(&[("406", "NotAcceptable")]);
        }
        if matches!(rule, Rule::ByMethod | Rule::AcrossLabs) {
            add(&["Lab"]);
        }
        if conditional {
            add(&["IfMatch", "IfNoneMatch"]);
            may(&[("304", "NotModified"), ("412", "PreconditionFailed")]);
        }
        if ["patch", "delete"].contains(&method) && rule != Rule::Own {
            add(&["IfMatch"]);
            may(&[("412", "PreconditionFailed")]);
        }
        if path.ends_with("/cancel") || path.ends_with("/retry") {
            add(&["IfMatch"]);
        }
        if ranges {
            add(&["Range", "IfRange"]);
            may(&[("416", "RangeNotSatisfiable")]);
        }
        if wait {
            add(&["Prefer"]);
        }
        if let Some(body) = prose.remove("body") {
            may(&[("413", "TooLarge"), ("415", "UnsupportedMediaType"), ("422", "Unprocessable")]);
            let mut media = media("application/json", expand("schemas", body));
            if let Some(example) = prose.remove("example") {
                let json = media["application/json"].as_mapping_mut().unwrap();
                json.insert("example".into(), example);
            }
            let request = BTreeMap::from([("required", value(true)), ("content", media)]);
            prose.insert("requestBody".into(), value(request));
        }
        for (status, answer) in &mut answers {
            let Some(answer) = answer.as_mapping_mut().filter(|_| status.starts_with('2')) else {
                continue;
            };
            if answer.contains_key("$ref") {
                continue;
            }
            let is_json =
                answer.get("content").is_some_and(|kinds| !kinds["application/json"].is_null());
            let mut header = |name: &str, component: &str| {
                map(answer, "headers").insert(name.into(), reference("headers", component));
            };
            if (conditional && status == "200")
                || (method != "get" && guarded && is_json && rule != Rule::Own && !untagged)
            {
                header("ETag", "ETag");
            }
            if guarded {
                header("RateLimit", "RateLimit");
                header("RateLimit-Policy", "RateLimitPolicy");
            }
            if ranges && status == "200" {
                header("Accept-Ranges", "AcceptRanges");
            }
            if wait {
                header("Preference-Applied", "PreferenceApplied");
            }
        }
        if ranges {
            let mut part = answers["200"].clone();
            let fields = part.as_mapping_mut().unwrap();
            fields.insert("description".into(), value("The requested range."));
            let headers = map(fields, "headers");
            headers.remove("Accept-Ranges");
            headers.insert("Content-Range".into(), reference("headers", "ContentRange"));
            map(fields, "content").remove("application/json");
            answers.insert("206".into(), part);
        }
        if !parameters.is_empty() {
            let expanded = parameters.into_iter().map(|name| expand("parameters", name));
            prose.insert("parameters".into(), Value::Sequence(expanded.collect()));
        }
        prose.insert("responses".into(), value(answers));
        if path.starts_with("/view/") {
            prose.insert("tags".into(), value(["view"]));
            prose.insert("x-internal".into(), value(true));
        }
        // A fixed order of keys, whatever the prose has.
        let mut ordered = Mapping::new();
        for key in [
            "tags",
            "x-internal",
            "operationId",
            "security",
            "summary",
            "description",
            "parameters",
            "requestBody",
            "responses",
        ] {
            if let Some(content) = prose.remove(key) {
                let content = match content {
                    Value::Mapping(map) => Value::Mapping(schemas(map)),
                    other => other,
                };
                ordered.insert(key.into(), content);
            }
        }
        assert!(prose.is_empty(), "{method} {path}: unknown {prose:?}");
        Value::Mapping(ordered)
    }

    /// Schemas by name.
    type Schemas = BTreeMap<String, Json>;

    macro_rules! schemas_of {
        ($settings:expr; $($kind:ty),* $(,)?) => {{
            let settings = $settings.with(|settings| {
                settings.definitions_path = "/components/schemas".into();
                settings.meta_schema = None;
            });
            let mut generator = settings.into_generator();
            $(generator.subschema_for::<$kind>();)*
            let found: Schemas = generator.take_definitions(true).into_iter().collect();
            found
        }};
    }

    /// The bodies of requests, which are closed: an unknown field is refused.
    fn requests() -> Schemas {
        let mut schemas = schemas_of! {
            SchemaSettings::draft2020_12().for_deserialize();
            CalibrationRequest, MeasurementRequest, ModelRequest, JobRequest, jobs::Changes, labs::Changes,
            page::Renaming, samples::SampleRequest, exports::movie::ExportRequest,
        };
        schemas.values_mut().for_each(|schema| plain(schema, false));
        schemas
    }

    /// The bodies of answers, which are open: a later version may add fields and values.
    fn answers() -> Schemas {
        let mut schemas = schemas_of! {
            SchemaSettings::draft2020_12().for_serialize();
            me::MeBody, session::SessionBody, labs::ListBody, PageBody<BlobRow>, PageBody<tus::UploadBody>,
            PageBody<CalibrationBody>, CalibrationReport, PageBody<MeasurementBody>, PageBody<ModelBody>,
            algorithms::ListBody, PageBody<JobBody>, jobs::EstimateBody, samples::SampleBody,
            exports::movie::ExportBody, PageBody<results::SnapshotBody>, quality::QualityBody, tiles::TilesBody,
            TileHistory, SpreadBody, events::Change, system::SystemBody, system::Readiness,
            system::Liveness, Problem, Blob, labs::LabBody, Manifest, JobManifest,
        };
        schemas.values_mut().for_each(|schema| plain(schema, true));
        schemas
    }

    /// Writes a schema as generators of clients read it best, and opens that of an answer.
    fn plain(schema: &mut Json, open: bool) {
        if let Json::Array(items) = schema {
            items.iter_mut().for_each(|item| plain(item, open));
        }
        let Json::Object(fields) = schema else { return };
        if let Some(variants) = fields.get("oneOf").and_then(constants) {
            fields.remove("oneOf");
            let known: Vec<Json> = variants.iter().map(|(name, _)| json!(name)).collect();
            let explained = variants
                .iter()
                .filter_map(|(name, about)| Some(format!("- `{name}`: {}", about.as_ref()?)));
            let about = fields.get("description").and_then(Json::as_str).unwrap_or_default();
            let lines: Vec<String> = [about.to_owned()].into_iter().chain(explained).collect();
            fields.insert("description".into(), lines.join("\n").trim().into());
            fields.insert("type".into(), "string".into());
            fields.insert("enum".into(), known.into());
        }
        if let Some(value) = fields.remove("const") {
            fields.insert("enum".into(), json!([value]));
        }
        let unsigned = ["uint", "uint8", "uint16", "uint32", "uint64"];
        if let Some(format) = fields.get("format").and_then(Json::as_str).map(str::to_owned)
            && unsigned.contains(&format.as_str())
        {
            fields.insert("format".into(), "int64".into());
            fields.entry("minimum").or_insert(json!(0));
            if format == "uint32" && !open {
                fields.entry("maximum").or_insert(json!(u32::MAX));
            }
        }
        // The identifier of a document, and rules between fields that generators do not read.
        for name in ["$id", "title", "allOf"] {
            fields.remove(name);
        }
        if let Some(about) = fields.get("description").and_then(Json::as_str) {
            let about = prose(about);
            fields.insert("description".into(), about.into());
        }
        if fields.get("default").is_some_and(Json::is_null) {
            fields.remove("default");
        }
        if open {
            fields
                .remove("additionalProperties")
                .filter(|more| more.is_object())
                .map(|more| fields.insert("additionalProperties".into(), more));
            if let Some(known) = fields.remove("enum") {
                fields.insert("x-extensible-enum".into(), known);
            }
            // Open values do not exclude one another.
            if let Some(variants) = fields.remove("oneOf") {
                fields.insert("anyOf".into(), variants);
                fields.remove("unevaluatedProperties");
            }
            // A schedule of `learned` has no stages.
            fields.remove("minItems");
        }
        for (key, inner) in fields.iter_mut() {
            match (key.as_str(), inner) {
                ("properties", Json::Object(properties)) => {
                    properties.values_mut().for_each(|property| plain(property, open));
                }
                ("items" | "additionalProperties" | "anyOf" | "oneOf" | "prefixItems", inner) => {
                    plain(inner, open);
                }
                _ => {}
            }
        }
    }

    /// A doc comment as plain text: without links to code, lines of a paragraph joined.
    fn prose(about: &str) -> String {
        let paragraphs = about.split("\n\n").map(|paragraph| {
            let lines = paragraph.replace("\n- ", "\u{0}- ").replace('\n', " ");
            lines.replace('\u{0}', "\n")
        });
        let text = paragraphs.collect::<Vec<_>>().join("\n\n");
        let text = text.replace("[`", "`").replace("`]", "`").replace("`None`", "null");
        text.replace("\\[", "[").replace("\\]", "]")
    }

    /// The texts, and what they mean, if every variant is one.
    fn constants(variants: &Json) -> Option<Vec<(String, Option<String>)>> {
        let mut found = Vec::new();
        for variant in variants.as_array()? {
            let about = variant["description"].as_str().map(|about| about.replace('\n', " "));
            match (&variant["const"], &variant["enum"]) {
                (Json::String(name), _) => found.push((name.clone(), about)),
                (_, Json::Array(names)) => {
                    for name in names {
                        found.push((name.as_str()?.to_owned(), None));
                    }
                }
                _ => return None,
            }
        }
        Some(found)
    }

    /// The schemas of all types. If the form in answers differs from the form in requests, its name ends in `Output`.
    fn derived() -> Schemas {
        let (mut all, answers) = (requests(), answers());
        let twice: Vec<String> = answers
            .iter()
            .filter(|(name, schema)| all.get(*name).is_some_and(|other| other != *schema))
            .map(|(name, _)| name.clone())
            .collect();
        // A schema that refers to a renamed one differs, too.
        let text = serde_json::to_string(&answers).unwrap();
        let renamed = twice.iter().fold(text, |text, name| {
            let place = |name: &str| format!("\"#/components/schemas/{name}\"");
            text.replace(&place(name), &place(&format!("{name}Output")))
        });
        let answers: Schemas = serde_json::from_str(&renamed).unwrap();
        for (name, schema) in answers {
            let name = if twice.contains(&name) { format!("{name}Output") } else { name };
            all.insert(name, schema);
        }
        all
    }

    /// The contract as it follows from prose, routes and types.
    fn assembled() -> String {
        let mut document: Mapping = serde_yaml_ng::from_str(PROSE).unwrap();
        let components = map(&mut document, "components");
        for (name, schema) in derived() {
            let before = map(components, "schemas").insert(name.as_str().into(), value(schema));
            assert!(before.is_none(), "the prose has the schema {name}, which follows from a type");
        }
        let rules: BTreeMap<String, Rule> = routes()
            .into_iter()
            .map(|route| (route.path.replace("{*path}", "{path}"), route.rule))
            .collect();
        for (path, item) in map(&mut document, "paths") {
            let path = path.as_str().unwrap().to_owned();
            let rule = *rules.get(&path).unwrap_or_else(|| panic!("there is no route {path}"));
            for (key, content) in item.as_mapping_mut().unwrap() {
                match (key.as_str().unwrap(), std::mem::take(content)) {
                    (method, Value::Mapping(prose)) if METHODS.contains(&method) => {
                        *content = operation(prose, (method, &path, rule));
                    }
                    ("parameters", Value::Sequence(names)) => {
                        let all = names.into_iter().map(|name| expand("parameters", name));
                        *content = Value::Sequence(all.collect());
                    }
                    (key, _) => panic!("{path} has {key}"),
                }
            }
        }
        let head = "# Assembled from src/http/contract.yaml, the routes and the types: edit those, then run\n\
                    # SCI_RECON_WRITE_CONTRACT=1 cargo test -p sci-recon --lib contract\n";
        format!("{head}{}", serde_yaml_ng::to_string(&document).unwrap())
    }

    #[test]
    fn the_contract_follows_from_prose_and_code() {
        let text = assembled();
        if std::env::var_os("SCI_RECON_WRITE_CONTRACT").is_some() {
            let path = concat!(env!("CARGO_MANIFEST_DIR"), "/openapi.yaml");
            std::fs::write(path, &text).unwrap();
            return;
        }
        assert!(
            text == YAML,
            "openapi.yaml is out of date: run SCI_RECON_WRITE_CONTRACT=1 cargo test -p sci-recon --lib contract"
        );
    }

    /// A stage with the prior `fastdvdnet-int8` fits several variants, because later versions may add names of priors.
    #[test]
    fn variants_of_answers_may_overlap() {
        for (name, schema) in answers() {
            let text = schema.to_string();
            assert!(
                !text.contains("\"oneOf\""),
                "{name} excludes an answer that fits two variants"
            );
            assert!(!text.contains("\"unevaluatedProperties\""), "{name} excludes later fields");
        }
    }

    #[test]
    fn the_public_surface_is_small_and_complete() {
        let document: Value = serde_yaml_ng::from_str(YAML).unwrap();
        let (mut public, mut internal) = (Vec::new(), Vec::new());
        for (path, item) in document["paths"].as_mapping().unwrap() {
            for (method, operation) in item.as_mapping().unwrap() {
                let (path, method) = (path.as_str().unwrap(), method.as_str().unwrap());
                if method == "parameters" {
                    continue;
                }
                let name = format!("{method} {path}");
                let kinds = ["jobs", "calibrations", "measurements", "models", "blobs", "uploads"];
                if kinds.iter().any(|kind| path.starts_with(&format!("/v1/{kind}"))) {
                    let lab = value(BTreeMap::from([("$ref", "#/components/parameters/Lab")]));
                    let parameters = operation["parameters"].as_sequence().unwrap();
                    assert!(parameters.contains(&lab), "{name} lacks `lab`");
                }
                for (status, answer) in operation["responses"].as_mapping().unwrap() {
                    let kinds = answer["content"].as_mapping().into_iter().flatten();
                    for (kind, content) in
                        kinds.filter(|(kind, _)| kind.as_str().unwrap().contains("json"))
                    {
                        let named = !content["schema"]["$ref"].is_null();
                        let plain = path == "/openapi.json";
                        assert!(named || plain, "{name}: {status:?} {kind:?} has no named schema");
                    }
                }
                let body = &operation["requestBody"]["content"]["application/json"];
                assert!(body.is_null() || !body["example"].is_null(), "{name}: no example");
                let list =
                    if operation["x-internal"] == true { &mut internal } else { &mut public };
                list.push(name);
            }
        }
        assert!(public.len() <= 55, "{} operations: {public:#?}", public.len());
        assert!(internal.iter().all(|name| !name.contains("/v1/")), "{internal:#?}");
        assert!(public.iter().all(|name| !name.contains("/view/")), "{public:#?}");
    }
}
