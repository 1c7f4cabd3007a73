//! The service against its contract, and its monitoring.

use std::collections::BTreeSet;
use std::io::Read;
use std::sync::LazyLock;

use reqwest::Method;
use serde_json::{Value, json};

use crate::app::{Answer, TestApp};
use crate::samples::Scene;

static CONTRACT: LazyLock<Value> = LazyLock::new(|| {
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/openapi.yaml");
    serde_yaml_ng::from_str(&std::fs::read_to_string(path).unwrap()).unwrap()
});

/// Follows a reference. Returns any other value unchanged.
fn resolve(value: &Value) -> &Value {
    match value["$ref"].as_str() {
        Some(place) => CONTRACT.pointer(place.trim_start_matches('#')).unwrap(),
        None => value,
    }
}

/// Fails unless the contract has this answer: its status, its headers, the error code under that status, and the
/// required fields.
#[track_caller]
pub fn check(method: &Method, path: &str, answer: &Answer) {
    let Some(operation) = operation(method, path) else { return };
    let status = answer.status.as_str();
    let documented = resolve(&operation["responses"][status]);
    let text = String::from_utf8_lossy(&answer.bytes);
    assert!(
        !documented.is_null(),
        "{method} {path}: no {status} in the contract; the answer was {text}"
    );
    for name in ["ETag", "Location", "Retry-After"] {
        let is_documented = documented["headers"].get(name).is_some();
        let is_sent = answer.headers.contains_key(name);
        // An answer for which there is no estimate lacks it.
        let may_lack = name == "Retry-After" && status != "429";
        assert!(
            is_sent == is_documented || (may_lack && !is_sent),
            "{method} {path}: {name} of {status} is sent: {is_sent}, documented: {is_documented}"
        );
    }
    let kind = answer.header("content-type").split(';').next().unwrap_or_default();
    let (false, "application/json" | "application/problem+json") = (answer.bytes.is_empty(), kind)
    else {
        return;
    };
    let schema = resolve(&documented["content"][kind]["schema"]);
    assert!(!schema.is_null(), "{method} {path}: no {kind} for {status} in the contract");
    let body = answer.json();
    for field in schema["required"].as_array().into_iter().flatten() {
        let is_present = body.get(field.as_str().unwrap()).is_some();
        assert!(is_present, "{method} {path}: no field {field} in {text}");
    }
    for field in body.as_object().into_iter().flat_map(|body| body.keys()) {
        let known = schema["properties"].get(field).is_some() || schema["properties"].is_null();
        assert!(known, "{method} {path}: the contract has no field {field} of {text}");
    }
    if kind == "application/problem+json" {
        let code = format!("`{}`", body["code"].as_str().unwrap());
        let words = documented["description"].as_str().unwrap();
        assert!(words.contains(&code), "{method} {path}: no {code} under {status} in the contract");
    }
}

/// True if an object has the required fields of a schema and no unknown ones.
pub fn matches_schema(name: &str, object: &Value) -> bool {
    let schema = &CONTRACT["components"]["schemas"][name];
    let required = schema["required"].as_array().unwrap();
    let fields = object.as_object().unwrap();
    required.iter().all(|field| fields.contains_key(field.as_str().unwrap()))
        && fields.keys().all(|field| schema["properties"].get(field).is_some())
}

/// The operation of the contract. `None` for an unknown path or method.
fn operation<'a>(method: &Method, path: &str) -> Option<&'a Value> {
    let name = method.as_str().to_ascii_lowercase();
    let fits = |template: &str| {
        let (ours, theirs) = (path.split('/'), template.split('/'));
        // The rest of a path in a tree.
        let tree = template.ends_with("/{path}") && ours.clone().count() > theirs.clone().count();
        (tree || ours.clone().count() == theirs.clone().count())
            && ours.zip(theirs).all(|(part, pattern)| pattern.starts_with('{') || part == pattern)
    };
    let paths = CONTRACT["paths"].as_object().unwrap().iter();
    let (_, item) = paths
        .filter(|(template, _)| fits(template))
        .min_by_key(|(template, _)| template.matches('{').count())?;
    let get = if name == "head" { item.get("get") } else { None };
    item.get(&name).or(get)
}

#[tokio::test]
async fn the_contract_is_served_and_its_references_resolve() {
    let app = TestApp::start().await;
    let answer = app.get("/openapi.yaml").await.expect(200);
    let contract: Value = serde_yaml_ng::from_slice(&answer.bytes).unwrap();
    assert!(contract["openapi"].as_str().unwrap().starts_with("3."));
    let json = app.get("/openapi.json").await.expect(200).json();
    assert_eq!(
        json,
        serde_yaml_ng::from_str::<Value>(&String::from_utf8_lossy(&answer.bytes)).unwrap()
    );
    let packed = app.request(Method::GET, "/openapi.yaml").header("accept-encoding", "gzip");
    assert_eq!(app.send(packed).await.expect(200).header("content-encoding"), "gzip");
    // Every reference resolves.
    let text = String::from_utf8(answer.bytes).unwrap();
    for reference in text.split("$ref: '#/").skip(1) {
        let path = reference.split('\'').next().unwrap();
        let value = path.split('/').fold(&contract, |at, key| &at[key]);
        assert!(!value.is_null(), "{path} leads nowhere");
    }
}

#[tokio::test]
async fn the_reference_loads_its_files_from_the_service_alone() {
    let app = TestApp::start().await;
    let page = app.get("/docs").await.expect(200);
    let policy = page.header("content-security-policy").to_owned();
    assert!(policy.contains("script-src 'self'; style-src 'sha256-"), "{policy}");
    assert!(!policy.contains("unsafe"), "{policy}");
    let text = String::from_utf8(page.bytes).unwrap();
    let addresses = text.split("=\"").skip(1).map(|rest| rest.split('"').next().unwrap());
    let scripts: Vec<&str> = addresses.filter(|address| address.ends_with(".js")).collect();
    assert_eq!(
        scripts,
        ["docs/redoc.js", "docs/start.js"],
        "relative, so that a proxy may add a prefix"
    );
    for script in scripts {
        let path = format!("/{script}");
        let plain = app.get(&path).await.expect(200);
        assert!(plain.header("content-type").starts_with("text/javascript"), "{path}");
        let packed = app.request(Method::GET, &path).header("accept-encoding", "gzip");
        let packed = app.send(packed).await.expect(200);
        assert_eq!(packed.header("content-encoding"), "gzip", "{path}");
        let mut unpacked = Vec::new();
        flate2::read::GzDecoder::new(&packed.bytes[..]).read_to_end(&mut unpacked).unwrap();
        assert_eq!(unpacked, plain.bytes, "{path}");
        assert_ne!(plain.header("etag"), packed.header("etag"), "{path}");
        for etag in [plain.header("etag"), packed.header("etag")] {
            let known = app.request(Method::GET, &path).header("if-none-match", etag);
            assert_eq!(app.send(known).await.expect(304).header("etag"), etag, "{path}");
        }
    }
    let script = String::from_utf8(app.get("/docs/redoc.js").await.bytes).unwrap();
    assert!(script.contains("2.5.4") && !script.contains("cdn.redoc"));
    let licence = app.get("/docs/LICENSE.txt").await.expect(200);
    assert!(String::from_utf8_lossy(&licence.bytes).contains("The MIT License"));
    app.get("/docs/nothing.js").await.problem(404, "not_found");
}

#[tokio::test]
async fn every_error_type_has_a_page() {
    let app = TestApp::start().await;
    let refused = app.post("/v1/jobs", &json!({})).await;
    refused.problem(422, "invalid_request");
    let (place, _) = refused.header("link").split_once('>').unwrap();
    assert_eq!(place, "<../problems/invalid_request", "relative to the address of the request");
    let page = app.get("/problems/invalid_request").await.expect(200);
    assert!(page.header("content-type").starts_with("text/html"));
    assert!(page.header("content-security-policy").contains("default-src 'none'"));
    let text = String::from_utf8_lossy(&page.bytes);
    assert!(text.contains("invalid_request"));
    for place in ["../", "../docs"] {
        assert!(text.contains(&format!("href=\"{place}\"")), "a link to {place}");
    }
    app.get("/problems/nothing").await.problem(404, "not_found");
}

/// The text of all files below a folder with one of these endings.
fn sources(folder: &str, endings: &[&str]) -> String {
    let mut text = String::new();
    for entry in std::fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        let ending = path.extension().and_then(|ending| ending.to_str()).unwrap_or_default();
        if path.is_dir() && !path.ends_with("node_modules") {
            text += &sources(path.to_str().unwrap(), endings);
        } else if endings.contains(&ending) {
            text += &std::fs::read_to_string(path).unwrap();
        }
    }
    text
}

#[test]
fn no_client_and_no_example_uses_the_routes_of_the_pages() {
    let folders = ["clients", "docs", "src/cli", "demo", "deploy"];
    let text = folders.map(|folder| sources(folder, &["rs", "py", "md", "m", "sh"])).concat();
    let readme = std::fs::read_to_string("README.md").unwrap();
    assert!(text.contains("/v1/jobs") && !(text + &readme).contains("/view/"));
}

/// The query parameters of an operation by their names, without `lab`, which all operations share.
fn query_parameters(item: &Value, operation: &Value) -> BTreeSet<String> {
    let lists = [&item["parameters"], &operation["parameters"]];
    let all = lists.into_iter().filter_map(Value::as_array).flatten().map(resolve);
    let names =
        all.filter(|parameter| parameter["in"] == "query").map(|parameter| &parameter["name"]);
    names.map(|name| name.as_str().unwrap().to_owned()).filter(|name| name != "lab").collect()
}

#[tokio::test]
async fn every_route_refuses_unknown_query_parameters_and_knows_those_of_the_contract() {
    let app = TestApp::start().await;
    let id = "019ae4f0-6e5c-7c3a-9d1e-0d5f0a1b2c3d";
    let mut checked = 0;
    for (path, item) in CONTRACT["paths"].as_object().unwrap() {
        for (method, operation) in item.as_object().unwrap() {
            // Browsers and probes may add any parameters to public routes.
            let is_public = operation["security"] == json!([]);
            if method == "parameters" || is_public {
                continue;
            }
            let parts = path.split('/').map(|part| match part {
                "{sha256}" => "a".repeat(64),
                "{lab}" => "local".into(),
                "{format}" if path.ends_with("{path}") => "zarr".into(),
                "{format}" => "exr".into(),
                "{path}" => "zarr.json".into(),
                "{map}" => "mean.png".into(),
                "{picture}" if path.contains("measurements") => "snapshot-0".into(),
                "{picture}" if path.contains("calibrations") => "mean".into(),
                "{picture}" => "frame-1".into(),
                "{snapshot}" | "{tile}" | "{level}" | "{row}" | "{column}" => "0".into(),
                part if part.starts_with('{') => id.to_owned(),
                part => part.to_owned(),
            });
            let address = format!("{}?zz=1", parts.collect::<Vec<_>>().join("/"));
            let method = Method::from_bytes(method.to_ascii_uppercase().as_bytes()).unwrap();
            let request = app.request(method.clone(), &address).header("tus-resumable", "1.0.0");
            let answer = app.send(request).await;
            checked += 1;
            let name = format!("{method} {path}");
            if method == Method::HEAD {
                assert_eq!(answer.status, 400, "{name}");
                continue;
            }
            let detail = answer.problem(400, "invalid_query");
            let (_, known) =
                detail.split_once("`zz`").unwrap_or_else(|| panic!("{name}: {detail}"));
            let known = known.split('`').skip(1).step_by(2).map(str::to_owned);
            assert_eq!(known.collect::<BTreeSet<_>>(), query_parameters(item, operation), "{name}");
        }
    }
    assert!(checked > 60, "{checked}");
}

/// A schema of the contract with those that it refers to.
fn parts(schema: &'static Value) -> Vec<&'static Value> {
    let place = schema["$ref"].as_str().map(|place| CONTRACT.pointer(&place[1..]).unwrap());
    let variants = schema["anyOf"].as_array().into_iter().flatten();
    let inner = place.into_iter().chain(variants).flat_map(parts);
    [schema].into_iter().chain(inner).collect()
}

/// The first field of a value that a schema of the contract lacks or misses.
fn violation(schema: &'static Value, value: &Value, place: &str) -> Option<String> {
    let parts = parts(schema);
    match value {
        Value::Array(items) => {
            let schema = parts.iter().find_map(|part| part.get("items"))?;
            items.iter().find_map(|item| violation(schema, item, place))
        }
        Value::Object(fields) => {
            // Requests and tables have free names, and no properties.
            let known = parts.iter().filter_map(|part| part["properties"].as_object());
            let known: Vec<_> = known.flatten().collect();
            // Fields of a variant are not those of the others.
            let is_plain = parts.iter().all(|part| part["anyOf"].is_null());
            let required = parts.iter().filter_map(|part| part["required"].as_array());
            let mut required = required.flatten().filter(|_| is_plain);
            let missing = required.find(|name| !fields.contains_key(name.as_str().unwrap()));
            let missing = missing.map(|name| format!("{place} has no {name}"));
            missing.or_else(|| {
                fields.iter().filter(|_| !known.is_empty()).find_map(|(name, inner)| {
                    let place = format!("{place}/{name}");
                    match known.iter().find(|(other, _)| *other == name) {
                        Some((_, schema)) => violation(schema, inner, &place),
                        None => Some(format!("{place} is not in the contract")),
                    }
                })
            })
        }
        _ => None,
    }
}

#[tokio::test]
async fn manifests_have_the_fields_of_the_contract() {
    let app = TestApp::with(&["--workers", "1"]).await;
    let (_, measurement) = app.scene(&Scene::SMALL).await;
    for algorithm in ["gap-tv", "gap-tv3d"] {
        let job = app.submit(&json!({"measurement": measurement, "algorithm": algorithm})).await;
        assert_eq!(app.ended(&job).await["state"], "succeeded");
        for (place, schema) in [("", "JobManifest"), ("/snapshots/0", "SnapshotManifest")] {
            let path = format!("/v1/jobs/{job}{place}/exports/manifest");
            let manifest = app.get(&path).await.expect(200).json();
            let schema = &CONTRACT["components"]["schemas"][schema];
            assert_eq!(violation(schema, &manifest, algorithm), None);
        }
    }
}

/// Each way in takes all inputs and reports all findings: every cell of the table names a test that exists.
#[test]
fn every_way_in_has_its_tests() {
    let rust = ["tests/service", "src", "crates"].map(|folder| sources(folder, &["rs"])).concat();
    let walks = sources("tests/e2e", &["mjs"]);
    let table = std::fs::read_to_string("tests/WAYS.md").unwrap();
    let rows: Vec<&str> = table.lines().filter(|line| line.starts_with("| ")).skip(2).collect();
    assert_eq!(rows.len(), 16);
    for row in rows {
        let cells: Vec<&str> = row.trim_matches('|').split('|').map(str::trim).collect();
        assert_eq!(cells.len(), 8, "{row}");
        for (way, cell) in cells[1..].iter().enumerate() {
            let name = cell.trim_matches('`');
            let is_test = rust.contains(&format!("fn {name}("));
            let is_walk = way == 6 && walks.contains(&format!("export async function {name}("));
            assert!(!name.is_empty() && (is_test || is_walk), "no test {name}: {row}");
        }
    }
}

#[test]
fn the_dashboard_states_every_property_of_the_requests() {
    let forms = ["submit", "fields", "captures", "questions", "actions"];
    let forms =
        forms.map(|name| std::fs::read_to_string(format!("src/http/dashboard/{name}.js")).unwrap());
    let forms = forms.concat();
    let words: BTreeSet<&str> =
        forms.split(|c: char| !c.is_ascii_alphanumeric() && c != '_').collect();
    for schema in ["CalibrationRequest", "MeasurementRequest", "JobRequest"] {
        let properties = &CONTRACT["components"]["schemas"][schema]["properties"];
        for name in properties.as_object().unwrap().keys() {
            assert!(words.contains(name.as_str()), "{schema} has {name}, the form has not");
        }
    }
}

#[test]
fn the_dashboard_names_every_stage_of_the_contract() {
    let read = |path: &str| {
        std::fs::read_to_string(format!("{}/{path}", env!("CARGO_MANIFEST_DIR"))).unwrap()
    };
    let contract: Value = serde_yaml_ng::from_str(&read("openapi.yaml")).unwrap();
    let stages = &contract["components"]["schemas"]["ProgressStage"]["x-extensible-enum"];
    let script = read("src/http/dashboard/format.js");
    let (_, words) = script.split_once("const words = {").unwrap();
    let (words, _) = words.split_once('}').unwrap();
    for stage in stages.as_array().unwrap() {
        let key = format!("{}: \"", stage.as_str().unwrap());
        assert!(words.lines().any(|line| line.trim().starts_with(&key)), "no text for {stage}");
    }
}

#[tokio::test]
async fn health_names_missing_parts() {
    let app = TestApp::start().await;
    app.get("/livez").await.expect(200);
    let ready = app.get("/readyz").await.expect(503).json();
    assert_eq!(ready["database"], "ok");
    assert_eq!(ready["disk"], "ok");
    assert_eq!(ready["workers"], "no worker lives");
}

#[tokio::test]
async fn without_onnxruntime_only_jobs_with_networks_are_rejected() {
    let nowhere = [("ORT_DYLIB_PATH", "/nowhere/libonnxruntime.so")];
    let app = TestApp::in_environment(&["--workers", "1"], &nowhere).await;
    let (_, measurement) = app.scene(&Scene::SMALL).await;
    let mut body = json!({"measurement": measurement, "algorithm": "pnp-tv-fastdvdnet"});
    let refused = app.post("/v1/jobs", &body).await;
    let detail = refused.problem(422, "invalid_request");
    assert!(detail.contains("fetch-onnxruntime.sh") && !detail.contains("/nowhere"), "{detail}");
    assert_eq!(refused.json()["pointer"], "/algorithm");
    body["algorithm"] = json!("gap-tv");
    let job = app.submit(&body).await;
    assert_eq!(app.ended(&job).await["state"], "succeeded");
    let ready = app.get("/readyz").await.expect(200).json();
    assert_eq!((&ready["ready"], &ready["degraded"]), (&json!(true), &json!(true)));
    let networks = ready["networks"].as_str().unwrap();
    assert!(networks.contains("libonnxruntime was not found"), "{networks}");
}

#[tokio::test]
async fn metrics_count_requests_and_resources() {
    let app = TestApp::start().await;
    app.scene(&Scene::SMALL).await;
    app.get("/v1/nowhere").await.problem(404, "not_found");
    let answer = app.get("/metrics").await.expect(200);
    let text = String::from_utf8(answer.bytes).unwrap();
    for line in [
        "sci_recon_http_requests_total{method=\"POST\",route=\"/v1/calibrations\",status=\"201\"} 1",
        "sci_recon_http_requests_total{method=\"GET\",route=\"none\",status=\"404\"} 1",
        "sci_recon_blobs 4",
        "sci_recon_jobs{state=\"queued\"} 0",
        "sci_recon_workers 0",
    ] {
        assert!(text.lines().any(|text_line| text_line == line), "no {line} in\n{text}");
    }
}

#[tokio::test]
async fn a_second_server_on_the_same_folder_is_rejected() {
    let app = TestApp::start().await;
    let output = std::process::Command::new(env!("CARGO_BIN_EXE_sci-recon"))
        .args(["serve", "--listen", "127.0.0.1:0", "--workers", "0", "--data"])
        .arg(app.data())
        .output()
        .unwrap();
    assert!(!output.status.success());
    let text = String::from_utf8(output.stderr).unwrap();
    assert!(text.contains("another server uses"), "{text}");
    app.get("/livez").await.expect(200);
}

#[tokio::test]
async fn the_health_command_reports_readiness() {
    let mut app = TestApp::with(&["--workers", "1"]).await;
    let data = app.data().to_owned();
    let health = || {
        let mut command = std::process::Command::new(env!("CARGO_BIN_EXE_sci-recon"));
        command.args(["health", "--data"]).arg(&data).output().unwrap()
    };
    let limit = std::time::Instant::now() + std::time::Duration::from_secs(60);
    while !health().status.success() {
        assert!(std::time::Instant::now() < limit, "the service does not become ready");
        tokio::time::sleep(std::time::Duration::from_millis(200)).await;
    }
    assert!(String::from_utf8(health().stdout).unwrap().contains("\"ready\":true"));
    assert!(app.stop().success());
    let stopped = health();
    assert!(stopped.status.code() == Some(1) && !stopped.stderr.is_empty(), "{stopped:?}");
}

#[tokio::test]
async fn a_stop_is_clean() {
    let mut app = TestApp::start().await;
    assert!(app.data().join("server.json").exists());
    assert!(app.stop().success());
    assert!(!app.data().join("server.json").exists());
}
