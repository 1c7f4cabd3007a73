//! Movies: asked for at any time, made last, gone with what they show.

use super::{LEASE, Lab};
use crate::{Claimant, Heartbeat, Job, Movie};
use engine::job::{JobId, JobState, TaskKind};

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
async fn a_movie_is_made_when_nothing_else_is_to_be_done() {
    let lab = Lab::new().await;
    let job = lab.done().await;
    for _ in 0..2 {
        assert_eq!(
            lab.store.movie(&job, Some(1), &serde_json::Value::Null).await.unwrap(),
            Movie::Asked(None)
        );
    }
    assert_eq!(
        lab.store.movie(&job, None, &serde_json::Value::Null).await.unwrap(),
        Movie::Asked(None)
    );
    let other = lab.submit(-100).await;
    let done = lab.work_off().await;
    let movies = [TaskKind::Movie { snapshot: Some(1) }, TaskKind::Movie { snapshot: None }];
    assert_eq!(done[done.len() - 3], TaskKind::Manifest, "{done:?}");
    assert!(movies.iter().all(|movie| done[done.len() - 2..].contains(movie)), "{done:?}");
    lab.job(other).await;
    let one = lab.store.movie(&job, Some(1), &serde_json::Value::Null).await.unwrap();
    let all = lab.store.movie(&job, None, &serde_json::Value::Null).await.unwrap();
    let (Movie::Ready { sha256: one, .. }, Movie::Ready { sha256: all, size: 10 }) = (one, all)
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
    lab.store.movie(&job, None, &serde_json::Value::Null).await.unwrap();
    let task = lab.claim().await.unwrap();
    assert_eq!(task.kind, TaskKind::Movie { snapshot: None });
    assert_eq!(
        lab.store.movie(&job, None, &serde_json::Value::Null).await.unwrap(),
        Movie::Asked(Some(0.0))
    );
    lab.store.fail(&task.lease, "no codec", false).await.unwrap();
    lab.job(job.id).await;
    // It is told once, and then tried again.
    assert_eq!(
        lab.store.movie(&job, None, &serde_json::Value::Null).await.unwrap(),
        Movie::Failed("no codec".into())
    );
    assert_eq!(
        lab.store.movie(&job, None, &serde_json::Value::Null).await.unwrap(),
        Movie::Asked(None)
    );

    // A job may go while a worker is at its movie: here the one that leaves tiles to other machines.
    let claimant = Claimant::WithoutTiles;
    let task = lab.store.claim_as(claimant, lab.worker, LEASE).await.unwrap().unwrap();
    lab.store.delete_job(&engine::job::Lab::local(), job.id).await.unwrap();
    assert_eq!(lab.work(&task).await, Heartbeat::Lost);
    assert!(lab.claim().await.is_none());
}
