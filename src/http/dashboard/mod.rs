//! The dashboard: a web page embedded in the program.
//!
//! It consists of plain HTML, CSS and JavaScript modules that use the API like any other client. The
//! content security policy below forbids scripts and requests from other servers.

use std::sync::LazyLock;

use axum::http::{HeaderMap, HeaderValue};
use axum::response::Response;

use super::asset::Asset;
use super::error::{ApiError, Code, Result};
use super::extract::Params;

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
    "quality.js",
    "questions.js",
    "registration.js",
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

static ASSETS: LazyLock<Vec<(&str, Asset)>> = LazyLock::new(|| {
    let asset = |&(name, bytes): &(&'static str, &'static [u8])| {
        (name, Asset::new(media_type(name), bytes))
    };
    FILES.iter().map(asset).collect()
});

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
    asset.1.page(headers, HeaderValue::from_static(POLICY))
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
    use std::io::Write;

    use flate2::Compression;
    use flate2::write::GzEncoder;

    use super::FILES;

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
            for absolute in
                ["\"/dashboard/", "fetch(\"/", "href: \"/", "href=\"/", "src: \"/", "src=\"/"]
            {
                assert!(!text.contains(absolute), "{name} has {absolute}");
            }
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
        let packed = FILES.iter().map(|(_, bytes)| {
            let mut encoder = GzEncoder::new(Vec::new(), Compression::default());
            encoder.write_all(bytes).unwrap();
            encoder.finish().unwrap().len()
        });
        let bytes: usize = packed.sum();
        assert!(bytes < 150_000, "{bytes} bytes");
    }
}
