//! Turns of labs, and the order of the jobs of a lab.

use std::time::Duration;

use super::{LEASE, Lab, id};
use crate::{Claimant, Entitlement, Purpose, Store, WorkerEnd, WorkerPlace};
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

/// A GPU takes tiles and pilots, its host the other tasks. The estimate follows from the rates of the devices that live.
#[tokio::test]
async fn rates_of_a_gpu_and_of_a_cpu_are_independent() {
    let lab = Lab::new().await;
    let card = WorkerId::new();
    let place = WorkerPlace { device: Some("gpu".into()), ..WorkerPlace::default() };
    lab.store.worker_started(card, 2, &place, Claimant::Gpu).await.unwrap();
    id(lab.add_for(&named("local"), Algorithm::PnpNonlocal, 0, None, b"job").await.unwrap());
    let claim = async |claimant, worker| lab.store.claim_as(claimant, worker, LEASE).await.unwrap();
    assert!(claim(Claimant::Gpu, card).await.is_none());
    while let Some(task) = claim(Claimant::Host, lab.worker).await {
        assert!(!matches!(task.kind, TaskKind::Tile { .. } | TaskKind::Pilot), "{:?}", task.kind);
        lab.work(&task).await;
    }
    let pilot = claim(Claimant::Gpu, card).await.unwrap();
    assert_eq!(pilot.kind, TaskKind::Pilot);
    lab.work(&pilot).await;
    // The CPU takes 100 times as long as the card, for one tile of each.
    for (claimant, worker, milliseconds) in
        [(Claimant::Gpu, card, 10_000), (Claimant::Local, lab.worker, 1_000_000)]
    {
        let task = claim(claimant, worker).await.unwrap();
        assert!(matches!(task.kind, TaskKind::Tile { .. }));
        sqlx::query("UPDATE attempts SET started_at = started_at - ? WHERE outcome IS NULL")
            .bind(milliseconds)
            .execute(&lab.store.writer)
            .await
            .unwrap();
        lab.work(&task).await;
    }
    let eta = async || {
        // A store that was just opened has no forecast.
        let store = Store::open(lab.store.dir().root(), Purpose::Use).await.unwrap();
        let tile = TaskKind::Tile { snapshot: 0, snapshots: 1, tile: 0 };
        store.estimate(&[(tile, 10.0); 100]).await.unwrap().eta_seconds.unwrap()
    };
    let both = eta().await;
    lab.store.worker_ended(card, &WorkerEnd::Left).await.unwrap();
    let cpu = eta().await;
    lab.store.worker_started(card, 2, &place, Claimant::Gpu).await.unwrap();
    lab.store.worker_ended(lab.worker, &WorkerEnd::Left).await.unwrap();
    let host = WorkerPlace { device: Some("cpu".into()), ..WorkerPlace::default() };
    lab.store.worker_started(WorkerId::new(), 3, &host, Claimant::Host).await.unwrap();
    let card = eta().await;
    // The CPU does 2 % of the work of both.
    assert!((0.9..1.05).contains(&(both / card)), "{both} {card}");
    assert!((45.0..100.0).contains(&(cpu / card)), "{cpu} {card}");
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
