//! Files that are checked before something is made of them. A check that is done soon is part of its request. A
//! longer one goes on after the answer; it is on record, and is begun again by the next server if this one ends.

use std::fmt::Display;
use std::str::FromStr;
use std::time::Duration;

use axum::http::HeaderMap;
use serde::Serialize;
use serde::de::DeserializeOwned;
use serde_json::Value;
use tokio::sync::oneshot;
use tokio::time::timeout;
use tokio_util::sync::CancellationToken;

use super::access::{Access, Owner};
use super::app::App;
use super::error::{ApiError, Code, REQUEST_ID, Result};
use engine::job::InvalidId;
use store::{Check, Inserted, Made, NewCheck, RequestKey, Source, StoreError};

/// How long a request waits for a check where it does not say.
const PATIENCE: Duration = Duration::from_secs(10);
/// The longest that a request may wait.
const MOST_PATIENCE: f64 = 20.0;
/// So often a check is begun: it may be what ends the service.
const MOST_BEGUN: u32 = 5;
/// Before something that was refused for now is tried again.
const PAUSE: Duration = Duration::from_secs(5);

/// How far something is that is made of files.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub(super) enum Stage {
    /// Its files are checked, or masks are made of captures.
    Preparing,
    Ready,
    /// There will be nothing; `error` says why.
    Failed,
}

impl Stage {
    /// Of what is not ready, and why it will not be.
    pub(super) fn unready(error: Option<&String>) -> Self {
        if error.is_some() { Self::Failed } else { Self::Preparing }
    }
}

/// Why a check was not passed, as it is on record.
pub(super) fn problem(text: Option<String>) -> Result<Option<Value>> {
    let value = text.as_deref().map(serde_json::from_str).transpose();
    value.map_err(|error| ApiError::internal(&error))
}

/// A request for something that is made of checked files.
pub(super) trait Checked:
    Clone + Serialize + DeserializeOwned + Send + Sync + 'static
{
    const WHAT: Made;
    type Id: Copy + Display + FromStr<Err = InvalidId> + Send + Sync + 'static;
    /// What a check yields.
    type Passed: Send + 'static;

    fn new_id() -> Self::Id;

    /// What is on record while the check goes on; but for the request.
    fn draft(&self) -> NewCheck;

    /// Refuses what can be refused without a look into the files.
    fn vet(&self, app: &App, owner: &Owner) -> impl Future<Output = Result<()>> + Send;

    /// Looks into the files, until `stop`.
    fn check(
        self,
        app: &App,
        owner: &Owner,
        stop: &CancellationToken,
    ) -> impl Future<Output = Result<Self::Passed>> + Send;

    /// Puts what has passed on record.
    fn keep(
        app: &App,
        owner: &Owner,
        passed: Self::Passed,
        source: Source<'_, Self::Id>,
    ) -> impl Future<Output = Result<Inserted<Self::Id>>> + Send;
}

/// How long the client wants to wait for a check (RFC 7240): `Prefer: respond-async` or `wait=SECONDS`.
pub(super) fn patience(headers: &HeaderMap) -> Duration {
    let values = headers.get_all("prefer").iter().filter_map(|value| value.to_str().ok());
    let mut told = None;
    let mut is_async = false;
    for preference in values.flat_map(|value| value.split([',', ';'])) {
        let (name, value) = preference.split_once('=').unwrap_or((preference, ""));
        match name.trim().to_ascii_lowercase().as_str() {
            "respond-async" => is_async = true,
            // What can't be understood is ignored, as the RFC wants it.
            "wait" => told = value.trim().trim_matches('"').parse::<f64>().ok(),
            _ => {}
        }
    }
    match told.filter(|seconds| *seconds >= 0.0) {
        Some(seconds) => Duration::from_secs_f64(seconds.min(MOST_PATIENCE)),
        None if is_async => Duration::ZERO,
        None => PATIENCE,
    }
}

/// Makes what a request asks for, or finds what was made with the same key. Whose check is not done after
/// `patience` is on record as such.
pub(super) async fn made<R: Checked>(
    app: &App,
    access: &Access,
    request: R,
    key: Option<&RequestKey>,
    patience: Duration,
) -> Result<Inserted<R::Id>> {
    let owner = access.owner();
    if let Some(id) = app.store.made_with(&owner.lab, R::WHAT, key).await? {
        return Ok(Inserted::Before(id));
    }
    request.vet(app, &owner).await?;
    let (answer, answered) = oneshot::channel();
    let work = begin(app.clone(), owner, request, (key.cloned(), patience), answer);
    // Not broken off with the request.
    match REQUEST_ID.try_with(Clone::clone) {
        Ok(id) => drop(tokio::spawn(REQUEST_ID.scope(id, work))),
        Err(_) => drop(tokio::spawn(work)),
    }
    answered.await.unwrap_or_else(|_| Err(StoreError::Interrupted.into()))
}

async fn begin<R: Checked>(
    app: App,
    owner: Owner,
    request: R,
    (key, patience): (Option<RequestKey>, Duration),
    answer: oneshot::Sender<Result<Inserted<R::Id>>>,
) {
    let stop = app.closing.child_token();
    let draft = draft(&request);
    let mut check = Box::pin(request.check(&app, &owner, &stop));
    let soon = match patience.is_zero() {
        true => None,
        false => timeout(patience, &mut check).await.ok(),
    };
    // Who has gone meanwhile is told nothing.
    if let Some(passed) = soon {
        let made = match passed {
            Ok(passed) => R::keep(&app, &owner, passed, Source::Request(key.as_ref())).await,
            Err(error) => Err(error),
        };
        let _ = answer.send(made);
        return;
    }
    let id = R::new_id();
    let listed = app.checks.list(id.to_string(), stop.clone());
    let noted = match draft {
        Ok(draft) => {
            let whose = (&owner.lab, owner.token);
            let noted = app.store.add_check(whose, (R::WHAT, id), &draft, key.as_ref()).await;
            noted.map_err(Into::into)
        }
        Err(error) => Err(error),
    };
    let goes_on = matches!(noted, Ok(Inserted::New(_)));
    let _ = answer.send(noted);
    if goes_on {
        let passed = check.await;
        settle::<R>(&app, &owner, (id, &stop), passed).await;
    } else {
        stop.cancel();
    }
    drop(listed);
}

/// What is on record of a request while its files are checked.
fn draft<R: Checked>(request: &R) -> Result<NewCheck> {
    let text = serde_json::to_string(request).map_err(|error| ApiError::internal(&error))?;
    Ok(NewCheck { request: text, ..request.draft() })
}

/// Puts on record what came of a check that has outlasted its request.
async fn settle<R: Checked>(
    app: &App,
    owner: &Owner,
    (id, stop): (R::Id, &CancellationToken),
    passed: Result<R::Passed>,
) {
    let kept = match passed {
        Ok(passed) => R::keep(app, owner, passed, Source::Check(id)).await.map(drop),
        Err(error) => Err(error),
    };
    // A check that was stopped stays open for the next server, or was deleted.
    if let Err(error) = kept
        && !stop.is_cancelled()
    {
        tracing::info!(%id, lab = %owner.lab, ?error, "a check was not passed");
        fail(app, (id, stop), &error.problem()).await;
    }
}

async fn fail(app: &App, (id, stop): (impl Display, &CancellationToken), problem: &Value) {
    while let Err(error) = app.store.fail_check(&id, &problem.to_string()).await {
        tracing::error!(%id, %error, "the end of a check can't be noted");
        if stop.run_until_cancelled(tokio::time::sleep(PAUSE)).await.is_none() {
            return;
        }
    }
}

/// Begins a check again that an earlier server did not bring to its end.
pub(super) async fn resume<R: Checked>(app: App, check: Check) {
    let Check { id, lab, token, request, .. } = check;
    let stop = app.closing.child_token();
    let _listed = app.checks.list(id.clone(), stop.clone());
    let owner = Owner { lab, token };
    let (Ok(place), Ok(request)) = (id.parse::<R::Id>(), serde_json::from_str::<R>(&request))
    else {
        let detail = "an earlier version of the service took this request: send it again";
        fail(&app, (&id, &stop), &ApiError::new(Code::Internal, detail).problem()).await;
        return;
    };
    match app.store.begin_check(&id).await {
        Ok(begun) if begun > MOST_BEGUN => {
            let detail = format!("the service ended {MOST_BEGUN} times while the file was checked");
            fail(&app, (&id, &stop), &ApiError::new(Code::Internal, detail).problem()).await;
            return;
        }
        Ok(_) => {}
        // It was deleted a moment ago, or the database says in every other place what is wrong.
        Err(error) => return tracing::warn!(%id, %error, "a check was not begun again"),
    }
    loop {
        let passed = request.clone().check(&app, &owner, &stop).await;
        // Newer ones have taken the places in the line.
        if passed.as_ref().is_err_and(|error| error.code() == Code::TooManyChecks)
            && stop.run_until_cancelled(tokio::time::sleep(PAUSE)).await.is_some()
        {
            continue;
        }
        return settle::<R>(&app, &owner, (place, &stop), passed).await;
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use axum::http::{HeaderMap, HeaderValue};

    use super::{PATIENCE, patience};

    #[test]
    fn clients_say_how_long_they_wait() {
        let told = |values: &[&'static str]| {
            let mut headers = HeaderMap::new();
            for value in values {
                headers.append("prefer", HeaderValue::from_static(value));
            }
            patience(&headers)
        };
        assert_eq!(told(&[]), PATIENCE);
        assert_eq!(told(&["respond-async"]), Duration::ZERO);
        assert_eq!(told(&["respond-async, wait=3"]), Duration::from_secs(3));
        assert_eq!(told(&["Respond-Async", "wait=\"2.5\"; x=1"]), Duration::from_secs_f64(2.5));
        assert_eq!(told(&["wait=100"]), Duration::from_secs(20));
        assert_eq!(told(&["wait=-1, handling=lenient"]), PATIENCE);
        assert_eq!(told(&["wait=NaN"]), PATIENCE);
    }
}
