//! Tasks that fail, crash or are interrupted, and results that are damaged.

use super::{Lab, tile};
use crate::{Heartbeat, MAX_FAILURES, MAX_LOSSES, MAX_STARVED, WorkerEnd};
use engine::job::{JobState, TaskKind, TaskProgress};

#[tokio::test]
async fn an_error_that_no_repetition_helps_fails_the_job_at_once() {
    let lab = Lab::new().await;
    let job = lab.submit(0).await;
    lab.work_on(3).await;
    let (task, sibling) = (lab.claim().await.unwrap(), lab.claim().await.unwrap());
    lab.store.fail(&task.lease, "the masks are gone", false).await.unwrap();
    let failed = lab.store.job(&engine::job::Lab::local(), job).await.unwrap();
    assert_eq!(failed.state, JobState::Failed);
    assert_eq!(failed.error.unwrap(), "tile 0 of snapshot 0: the masks are gone");
    let beat = lab.store.heartbeat(&sibling.lease, TaskProgress::START, None).await.unwrap();
    assert_eq!(beat, Heartbeat::Cancelled, "the others need not go on");
    lab.store.give_back(&sibling.lease).await.unwrap();
    lab.store.retry_job(&engine::job::Lab::local(), job).await.unwrap();
    assert_eq!(lab.work_off().await.len(), 8, "all but what was done");
    assert_eq!(lab.state(job).await, JobState::Succeeded);
}

#[tokio::test]
async fn a_task_that_crashes_its_workers_is_given_up() {
    let lab = Lab::new().await;
    let job = lab.submit(0).await;
    for attempt in 1..=MAX_FAILURES {
        lab.skip_pauses().await;
        assert_eq!(lab.claim().await.unwrap().lease.attempt, attempt);
        let end = WorkerEnd::Crashed("signal 11".into());
        lab.store.worker_ended(lab.worker, &end).await.unwrap();
    }
    let error = lab.store.job(&engine::job::Lab::local(), job).await.unwrap().error.unwrap();
    assert_eq!(error, "preparing: the worker process died: signal 11 (3 attempts)");
}

#[tokio::test]
async fn a_task_without_memory_fails_and_one_without_disk_waits() {
    let lab = Lab::new().await;
    let job = lab.submit(0).await;
    for _ in 0..30 {
        lab.skip_pauses().await;
        let task = lab.claim().await.unwrap();
        lab.store.postpone(&task.lease, "no space left on device").await.unwrap();
    }
    assert_eq!(lab.state(job).await, JobState::Running);
    for _ in 0..MAX_STARVED {
        lab.skip_pauses().await;
        lab.claim().await.unwrap();
        let end = WorkerEnd::Starved("the machine had no memory left for it".into());
        lab.store.worker_ended(lab.worker, &end).await.unwrap();
    }
    let error = lab.store.job(&engine::job::Lab::local(), job).await.unwrap().error.unwrap();
    assert_eq!(error, "preparing: the machine had no memory left for it (5 attempts)");
}

#[tokio::test]
async fn an_interrupted_task_is_retried_many_times() {
    let lab = Lab::new().await;
    let job = lab.submit(0).await;
    for _ in 1..MAX_LOSSES {
        lab.claim().await.unwrap();
        lab.store.worker_ended(lab.worker, &WorkerEnd::Killed).await.unwrap();
    }
    for _ in 0..5 {
        let task = lab.claim().await.unwrap();
        lab.store.give_back(&task.lease).await.unwrap();
    }
    assert_eq!(lab.state(job).await, JobState::Running, "giving back is no loss");
    lab.claim().await.unwrap();
    lab.store.worker_ended(lab.worker, &WorkerEnd::Killed).await.unwrap();
    assert_eq!(lab.state(job).await, JobState::Failed, "but there is an end");
}

#[tokio::test]
async fn damaged_tiles_are_done_again() {
    let lab = Lab::new().await;
    let job = lab.submit(0).await;
    lab.work_on(8).await;
    let assemble = lab.claim().await.unwrap();
    assert_eq!(assemble.kind, TaskKind::Assemble { snapshot: 0 });
    assert_eq!(lab.store.tile_results(job, 0).await.unwrap().len(), 2);
    lab.store.redo_tiles(&assemble.lease, &[(0, 1)]).await.unwrap();
    let done = lab.work_off().await;
    assert_eq!(done[..2], [tile(0, 1), TaskKind::Assemble { snapshot: 0 }]);
    assert_eq!(lab.state(job).await, JobState::Succeeded);
}
