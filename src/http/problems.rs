//! `/problems/{code}`: a page that explains a code of an error. The header `Link` of an error leads to it.

use axum::http::HeaderMap;
use axum::response::Response;
use maud::html;

use super::conditional;
use super::error::{ApiError, Code, Result};
use super::extract::Params;
use engine::intake::html_page;

pub(super) async fn show(Params(name): Params<String>, headers: HeaderMap) -> Result<Response> {
    let no_code = |_| ApiError::new(Code::NotFound, "no error of this service has this code");
    let code: Code = name.parse().map_err(no_code)?;
    Ok(conditional::page(&headers, page(code)))
}

fn page(code: Code) -> String {
    let (status, title, retryable, meaning) = code.row();
    let outcome = if retryable { "may succeed later" } else { "would fail again" };
    let style = html! { link rel="stylesheet" href="../dashboard/style.css"; };
    let body = html! {
        main {
            h1 { (title) }
            p { code { (code.into_str()) } ", status " (status.as_u16()) ". " (meaning) }
            p { "The same request " (outcome) ", unless " code { "retryable" } " of the answer is different." }
            p { a href="../" { "Dashboard" } " · " a href="../docs" { "API reference, which lists all codes" } }
        }
    };
    html_page(code.into_str(), &style, &body)
}
