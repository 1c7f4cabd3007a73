//! The dashboard: a web page embedded in the program and sent compressed.
//!
//! It consists of plain HTML, CSS and JavaScript modules that use the API like any other client. The
//! content security policy below forbids scripts and requests from other servers.

use std::io::Write;
use std::sync::LazyLock;

use axum::http::{HeaderMap, HeaderName, HeaderValue, StatusCode, header};
use axum::response::{IntoResponse, Response};
use flate2::Compression;
use flate2::write::GzEncoder;

use super::conditional;
use super::error::{ApiError, Code, Result};
use super::extract::Params;
use engine::job::Sha256;

/// Content security policy: the browser may load our files, and images that a module has fetched.
const POLICY: &str = "default-src 'none'; script-src 'self'; style-src 'self'; \
     img-src 'self' blob: data:; connect-src 'self'; base-uri 'none'; form-action 'none'; \
     frame-ancestors 'none'";

const PAGE: &str = "index.html";

macro_rules! files {
    ($($name:literal),+ $(,)?) => {
        [$(($name, include_bytes!($name).as_slice())),+]
    };
}

/// Name and content of every file.
const FILES: &[(&str, &[u8])] = &files![
    "index.html",
    "style.css",
    "icon.svg",
    "sample.webp",
    "main.js",
    "actions.js",
    "api.js",
    "calibrations.js",
    "captures.js",
    "compare.js",
    "contrast.js",
    "convergence.js",
    "dom.js",
    "drop.js",
    "fields.js",
    "filters.js",
    "format.js",
    "job.js",
    "jobs.js",
    "live.js",
    "menu.js",
    "movie.js",
    "pane.js",
    "player.js",
    "plot.js",
    "probe.js",
    "provenance.js",
    "report.js",
    "rows.js",
    "signin.js",
    "slice.js",
    "storage.js",
    "submit.js",
    "system.js",
    "thumb.js",
    "tilemap.js",
    "values.js",
    "verdict.js",
    "view.js",
    "viewer.js",
    "welcome.js",
];

/// A document in two representations, each with its own strong ETag.
#[derive(Debug)]
pub(super) struct Asset {
    kind: &'static str,
    plain: Representation,
    packed: Representation,
}

#[derive(Debug)]
struct Representation {
    bytes: Vec<u8>,
    etag: String,
}

impl Representation {
    fn new(bytes: Vec<u8>) -> Self {
        Self { etag: conditional::etag(&Sha256::of(&bytes)), bytes }
    }
}

static ASSETS: LazyLock<Vec<(&str, Asset)>> = LazyLock::new(|| {
    let asset = |&(name, bytes): &(&'static str, &[u8])| {
        (name, Asset::new(media_type(name), bytes.to_vec()))
    };
    FILES.iter().map(asset).collect()
});

fn pack(bytes: &[u8]) -> std::io::Result<Vec<u8>> {
    let mut encoder = GzEncoder::new(Vec::new(), Compression::best());
    encoder.write_all(bytes)?;
    encoder.finish()
}

impl Asset {
    pub(super) fn new(kind: &'static str, bytes: Vec<u8>) -> Self {
        // Writing to memory does not fail. If it did, the document would be sent uncompressed.
        let packed = pack(&bytes).unwrap_or_else(|_| bytes.clone());
        Self { kind, plain: Representation::new(bytes), packed: Representation::new(packed) }
    }

    /// The representation that the client takes, 304 or 412.
    pub(super) fn answer(&self, headers: &HeaderMap) -> Result<Response> {
        let gzip = takes_gzip(headers);
        let file = if gzip { &self.packed } else { &self.plain };
        conditional::check_match(headers, &file.etag)?;
        let known = conditional::is_known(headers, &file.etag);
        let mut response = match known {
            true => StatusCode::NOT_MODIFIED.into_response(),
            false => file.bytes.clone().into_response(),
        };
        let fields = response.headers_mut();
        let mut set = |name: HeaderName, value: &'static str| {
            fields.insert(name, HeaderValue::from_static(value));
        };
        set(header::CONTENT_TYPE, self.kind);
        // The browser revalidates every file, so it never mixes old and new modules after an update.
        set(header::CACHE_CONTROL, "no-cache");
        set(header::VARY, "accept-encoding");
        set(header::X_CONTENT_TYPE_OPTIONS, "nosniff");
        if gzip && !known {
            set(header::CONTENT_ENCODING, "gzip");
        }
        if let Ok(etag) = HeaderValue::try_from(&file.etag) {
            fields.insert(header::ETAG, etag);
        }
        Ok(response)
    }
}

pub(super) async fn page(headers: HeaderMap) -> Result<Response> {
    send(PAGE, &headers)
}

pub(super) async fn file(Params(name): Params<String>, headers: HeaderMap) -> Result<Response> {
    send(&name, &headers)
}

fn send(name: &str, headers: &HeaderMap) -> Result<Response> {
    let asset = ASSETS.iter().find(|(known, _)| *known == name).ok_or_else(|| {
        ApiError::new(Code::NotFound, "the dashboard has no file with this name; open / instead")
    })?;
    let mut response = asset.1.answer(headers)?;
    let fields = response.headers_mut();
    fields.insert(header::CONTENT_SECURITY_POLICY, HeaderValue::from_static(POLICY));
    fields.insert(header::REFERRER_POLICY, HeaderValue::from_static("no-referrer"));
    Ok(response)
}

/// True if the client lists gzip and does not rule it out.
fn takes_gzip(headers: &HeaderMap) -> bool {
    let lists = headers.get_all(header::ACCEPT_ENCODING).iter().filter_map(|v| v.to_str().ok());
    lists.flat_map(|list| list.split(',')).any(|item| {
        let (coding, weight) = item.split_once(';').unwrap_or((item, ""));
        let weight: String = weight.split_whitespace().collect();
        let refused = weight.strip_prefix("q=").is_some_and(|q| q.parse() == Ok(0.0f32));
        coding.trim().eq_ignore_ascii_case("gzip") && !refused
    })
}

fn media_type(name: &str) -> &'static str {
    match name.rsplit_once('.').map(|(_, kind)| kind) {
        Some("js") => "text/javascript; charset=utf-8",
        Some("css") => "text/css; charset=utf-8",
        Some("svg") => "image/svg+xml",
        Some("webp") => "image/webp",
        _ => "text/html; charset=utf-8",
    }
}

#[cfg(test)]
mod tests {
    use super::{ASSETS, FILES, takes_gzip};
    use axum::http::HeaderMap;

    #[test]
    fn imported_modules_are_served_and_all_files_are_listed() {
        let names: Vec<&str> = FILES.iter().map(|(name, _)| *name).collect();
        for (name, bytes) in FILES.iter().filter(|(name, _)| !name.ends_with(".webp")) {
            let text = std::str::from_utf8(bytes).unwrap();
            for import in text.split("from \"./").skip(1).chain(text.split("import(\"./").skip(1)) {
                let import = import.split('"').next().unwrap();
                assert!(names.contains(&import), "{name} imports {import}");
            }
            // An absolute address would fail behind a proxy that adds a path prefix.
            assert!(!text.contains("\"/dashboard/") && !text.contains("fetch(\"/"), "{name}");
            for path in text.split("\"dashboard/").skip(1) {
                let path = path.split('"').next().unwrap();
                assert!(names.contains(&path), "{name} names {path}");
            }
        }
        let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/src/http/dashboard");
        for entry in std::fs::read_dir(folder).unwrap() {
            let name = entry.unwrap().file_name().into_string().unwrap();
            assert!(name == "mod.rs" || names.contains(&name.as_str()), "{name} is not served");
        }
    }

    #[test]
    fn no_module_writes_markup_from_strings() {
        for (name, bytes) in FILES.iter().filter(|(name, _)| name.ends_with(".js")) {
            let text = std::str::from_utf8(bytes).unwrap();
            for forbidden in ["innerHTML", "outerHTML", "insertAdjacentHTML", "document.write"] {
                assert!(!text.contains(forbidden), "{name} uses {forbidden}");
            }
            assert!(text.lines().count() < 400, "{name} has too many lines: split it");
        }
    }

    #[test]
    fn the_compressed_files_stay_below_the_size_limit() {
        let bytes: usize = ASSETS.iter().map(|(_, asset)| asset.packed.bytes.len()).sum();
        assert!(bytes < 150_000, "{bytes} bytes");
    }

    #[test]
    fn gzip_is_sent_only_to_clients_that_accept_it() {
        let takes = |value: &str| {
            takes_gzip(&HeaderMap::from_iter([(
                "accept-encoding".parse().unwrap(),
                value.parse().unwrap(),
            )]))
        };
        for yes in ["gzip", "gzip, deflate, br", "br, GZIP;q=0.5", "deflate;q=0, gzip; q=1"] {
            assert!(takes(yes), "{yes}");
        }
        for no in ["", "br", "gzip;q=0", "gzip; q=0.0", "x-gzipped"] {
            assert!(!takes(no), "{no}");
        }
        assert!(!takes_gzip(&HeaderMap::new()));
    }
}
