//! `/problems/{code}`: a page that explains a code of an error. The header `Link` of an error leads to it.

use axum::http::{HeaderMap, HeaderValue, header};
use axum::response::Response;
use maud::{DOCTYPE, html};

use super::conditional;
use super::error::{ApiError, Code, Result};
use super::extract::Params;

/// Content security policy: the browser loads the style sheet of the service, and no scripts.
const POLICY: &str = "default-src 'none'; style-src 'self'; base-uri 'none'; form-action 'none'; \
     frame-ancestors 'none'";

pub(super) async fn show(Params(name): Params<String>, headers: HeaderMap) -> Result<Response> {
    let no_code = |_| ApiError::new(Code::NotFound, "no error of this service has this code");
    let code: Code = name.parse().map_err(no_code)?;
    let text = page(code).into_bytes();
    let mut response = conditional::content(&headers, "text/html; charset=utf-8", text);
    let policy = HeaderValue::from_static(POLICY);
    response.headers_mut().insert(header::CONTENT_SECURITY_POLICY, policy);
    Ok(response)
}

fn page(code: Code) -> String {
    let (status, title, retryable, meaning) = code.row();
    let outcome = if retryable { "may succeed later" } else { "would fail again" };
    html! {
        (DOCTYPE)
        html lang="en" {
            head {
                meta charset="utf-8";
                meta name="viewport" content="width=device-width, initial-scale=1";
                title { (code.into_str()) }
                link rel="stylesheet" href="../dashboard/style.css";
            }
            body {
                main {
                    h1 { (title) }
                    p { code { (code.into_str()) } ", status " (status.as_u16()) ". " (meaning) }
                    p { "The same request " (outcome) ", unless " code { "retryable" } " of the answer is different." }
                    p { a href="../" { "Dashboard" } " · " a href="../docs" { "API reference, which lists all codes" } }
                }
            }
        }
    }
    .into_string()
}
