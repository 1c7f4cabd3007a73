//! Movies: requested at any time, made in the turns of their lab, deleted with their jobs.

use serde_json::Value;

use super::{LEASE, Lab};
use crate::{Claimant, Heartbeat, Job, Movie};
use engine::job::{Algorithm, JobId, JobState, MovieFormat, TaskKind};

impl Lab {
    async fn done(&self) -> Job {
        let id = self.submit(0).await;
        self.work_off().await;
        self.job(id).await
    }

    async fn job(&self, id: JobId) -> Job {
        let job = self.store.job(&engine::job::Lab::local(), id).await.unwrap();
        assert_eq!(job.state, JobState::Succeeded);
        job
    }
}

#[tokio::test]
async fn a_movie_comes_before_the_jobs_of_its_lab() {
    let lab = Lab::new().await;
    let job = lab.done().await;
    for _ in 0..2 {
        let asked =
            lab.store.create_movie(&job, Some(1), MovieFormat::Mp4, &Value::Null).await.unwrap();
        assert_eq!(asked, Movie::Asked(None));
    }
    assert_eq!(
        lab.store.movie(&job, None, MovieFormat::Mp4).await.unwrap(),
        None,
        "reading creates no movie"
    );
    assert_eq!(
        lab.store.create_movie(&job, None, MovieFormat::Mp4, &Value::Null).await.unwrap(),
        Movie::Asked(None)
    );
    let other = lab.submit(-100).await;
    let done = lab.work_off().await;
    let movies = [TaskKind::Movie { snapshot: Some(1) }, TaskKind::Movie { snapshot: None }];
    assert_eq!(done[done.len() - 1], TaskKind::Manifest, "{done:?}");
    assert!(movies.iter().all(|movie| done[..2].contains(movie)), "{done:?}");
    lab.job(other).await;
    let one = lab.store.movie(&job, Some(1), MovieFormat::Mp4).await.unwrap();
    let all = lab.store.movie(&job, None, MovieFormat::Mp4).await.unwrap();
    let (Some(Movie::Ready { sha256: one, .. }), Some(Movie::Ready { sha256: all, size: 10 })) =
        (one, all)
    else {
        panic!()
    };
    assert!(lab.store.dir().blob(&one).exists() && lab.store.dir().blob(&all).exists());
    lab.store.delete_job(&engine::job::Lab::local(), job.id).await.unwrap();
    assert!(!lab.store.dir().blob(&one).exists() && !lab.store.dir().blob(&all).exists());
}

#[tokio::test]
async fn a_movie_that_fails_fails_nothing_else() {
    let lab = Lab::new().await;
    let job = lab.done().await;
    lab.store.create_movie(&job, None, MovieFormat::Mp4, &Value::Null).await.unwrap();
    let task = lab.claim().await.unwrap();
    assert_eq!(task.kind, TaskKind::Movie { snapshot: None });
    assert_eq!(
        lab.store.movie(&job, None, MovieFormat::Mp4).await.unwrap(),
        Some(Movie::Asked(Some(0.0)))
    );
    lab.store.fail(&task.lease, "no codec", false).await.unwrap();
    lab.job(job.id).await;
    let failed = Some(Movie::Failed("no codec".into()));
    for _ in 0..2 {
        assert_eq!(lab.store.movie(&job, None, MovieFormat::Mp4).await.unwrap(), failed);
    }
    assert_eq!(
        lab.store.create_movie(&job, None, MovieFormat::Mp4, &Value::Null).await.unwrap(),
        Movie::Asked(None)
    );

    // A job may go while a worker is at its movie: here the one that leaves tiles to other machines.
    let claimant = Claimant::WithoutTiles;
    let task = lab.store.claim_as(claimant, lab.worker, LEASE).await.unwrap().unwrap();
    lab.store.delete_job(&engine::job::Lab::local(), job.id).await.unwrap();
    assert_eq!(lab.work(&task).await, Heartbeat::Lost);
    assert!(lab.claim().await.is_none());
}

#[tokio::test]
async fn a_movie_takes_its_labs_turn_in_a_queue_that_never_ends() {
    let lab = Lab::new().await;
    let job = lab.done().await;
    let other = "other".parse().unwrap();
    for _ in 0..5 {
        lab.submit(0).await;
        lab.add_for(&other, Algorithm::GapTv, 0, None, b"request").await.unwrap();
    }
    // Jobs of both labs have begun.
    lab.work_on(6).await;
    lab.store.create_movie(&job, Some(0), MovieFormat::Mp4, &Value::Null).await.unwrap();
    let mut before = 0;
    loop {
        let task = lab.claim().await.unwrap();
        lab.work(&task).await;
        if matches!(task.kind, TaskKind::Movie { .. }) {
            break;
        }
        before += 1;
    }
    assert!(before <= 3, "{before} tasks came before it");
    // An administrator's urgent job comes first.
    lab.store.create_movie(&job, None, MovieFormat::Mp4, &Value::Null).await.unwrap();
    lab.submit(5).await;
    assert_eq!(lab.claim().await.unwrap().kind, TaskKind::Prepare);
}
