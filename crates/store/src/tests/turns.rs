//! Turns of labs, and the order of the jobs of a lab.

use std::time::Duration;

use super::{Lab, id};
use crate::{Claimant, Entitlement, WorkerEnd, WorkerPlace};
use engine::job::{Algorithm, JobId, TaskKind, WorkerId};

fn named(name: &str) -> engine::job::Lab {
    name.parse().unwrap()
}

impl Lab {
    async fn submit_for(&self, lab: &str, priority: i32) -> JobId {
        id(self.add_for(&named(lab), Algorithm::GapTv, priority, None, b"request").await.unwrap())
    }

    /// Does so many tasks, and says whose they were.
    async fn turns(&self, tasks: usize) -> Vec<JobId> {
        let mut jobs = Vec::new();
        for _ in 0..tasks {
            let Some(task) = self.claim().await else { break };
            jobs.push(task.step().job);
            self.work(&task).await;
        }
        jobs
    }

    /// Works off the queue, and says in which order the jobs ended.
    async fn ends(&self) -> Vec<JobId> {
        let mut ended = Vec::new();
        while let Some(task) = self.claim().await {
            if task.kind == TaskKind::Manifest {
                ended.push(task.step().job);
            }
            self.work(&task).await;
        }
        ended
    }
}

#[tokio::test]
async fn a_single_job_does_not_wait_for_all_jobs_of_another_lab() {
    let lab = Lab::new().await;
    let mut first = Vec::new();
    for _ in 0..6 {
        first.push(lab.submit_for("first", 0).await);
    }
    lab.turns(3).await;
    let second = lab.submit_for("second", 0).await;
    let ended = lab.ends().await;
    let place = |job| ended.iter().position(|ended| *ended == job).unwrap();
    assert!(place(second) < place(first[2]), "{ended:?}");
    let of_first: Vec<_> = ended.iter().copied().filter(|job| *job != second).collect();
    assert_eq!(of_first, first, "a lab's own jobs end in their order");
}

#[tokio::test]
async fn a_share_is_a_share_of_what_is_computed() {
    let lab = Lab::new().await;
    let to = Entitlement { share: Some(3.0), ..Entitlement::default() };
    lab.store.entitle(&named("second"), to).await.unwrap();
    let first = lab.submit_for("first", 0).await;
    let second = lab.submit_for("second", 0).await;
    // Until only tiles are left. Each lab has four, with equal costs.
    while lab.store.labs().await.unwrap().iter().any(|lab| lab.jobs > 0) {
        let task = lab.claim().await.unwrap();
        if matches!(task.kind, TaskKind::Tile { .. }) {
            lab.store.give_back(&task.lease).await.unwrap();
            break;
        }
        lab.work(&task).await;
    }
    sqlx::query("UPDATE labs SET start = 0, finish = 0").execute(&lab.store.writer).await.unwrap();
    sqlx::query("UPDATE tasks SET state = 'done' WHERE kind <> 'tile'")
        .execute(&lab.store.writer)
        .await
        .unwrap();
    let turns = lab.turns(4).await;
    let of = |job| turns.iter().filter(|turn| **turn == job).count();
    assert_eq!((of(first), of(second)), (1, 3));
}

#[tokio::test]
async fn an_idle_lab_collects_no_credit() {
    let lab = Lab::new().await;
    for _ in 0..3 {
        lab.submit_for("busy", 0).await;
    }
    lab.turns(15).await;
    let late = [lab.submit_for("late", 0).await, lab.submit_for("late", 0).await];
    let ended = lab.ends().await;
    assert!(ended.iter().position(|job| *job == late[1]) > Some(1), "{ended:?}");
}

#[tokio::test]
async fn running_jobs_precede_older_waiting_ones() {
    let lab = Lab::new().await;
    let (old, young) = (lab.submit_for("lab", 0).await, lab.submit_for("lab", 0).await);
    lab.store.cancel_job(&named("lab"), old).await.unwrap();
    assert_eq!(lab.turns(1).await, [young]);
    lab.store.retry_job(&named("lab"), old).await.unwrap();
    assert_eq!(lab.ends().await, [young, old]);
}

#[tokio::test]
async fn priority_comes_before_turns() {
    let lab = Lab::new().await;
    lab.submit_for("first", 0).await;
    let urgent = lab.submit_for("second", 5).await;
    let turns = lab.turns(10).await;
    assert!(turns.iter().all(|job| *job == urgent), "{turns:?}");
}

#[tokio::test]
async fn jobs_have_an_eta_only_while_a_worker_takes_tiles() {
    let lab = Lab::new().await;
    let local = named("local");
    let job = lab.submit_for("local", 0).await;
    let eta = async || {
        // A forecast of one job is valid for a fraction of a millisecond.
        tokio::time::sleep(Duration::from_millis(2)).await;
        let job = lab.store.job(&local, job).await.unwrap();
        lab.store.progress(&job).await.unwrap().eta_seconds
    };
    let age = Duration::from_secs(15);
    assert!(eta().await.is_some());
    assert_eq!(lab.store.live_tile_workers(age).await.unwrap(), 1);
    lab.store.worker_ended(lab.worker, &WorkerEnd::Left).await.unwrap();
    let last = lab.store.last_tile_worker().await.unwrap();
    for claimant in [Claimant::WithoutTiles, Claimant::Light] {
        let place = WorkerPlace::default();
        lab.store.worker_started(WorkerId::new(), 1, &place, claimant).await.unwrap();
    }
    assert_eq!((eta().await, lab.store.live_tile_workers(age).await.unwrap()), (None, 0));
    assert!(last.is_some(), "the sign of a worker that has ended");
    assert_eq!(lab.store.last_tile_worker().await.unwrap(), last);
}
