//! Jobs whose snapshots are reconstructed together.

use super::{Lab, id};
use crate::NewJob;
use engine::job::{
    Algorithm, JobId, JobState, RunSpec, Sequence, SnapshotRange, TaskKind, TileSpec,
};

impl Lab {
    /// A job with two tiles in each of two runs: snapshots 0 and 1, and 1 and 2.
    async fn submit_sequence(&self) -> JobId {
        let plain = self.submit(0).await;
        let local = engine::job::Lab::local();
        let mut spec = self.store.job(&local, plain).await.unwrap().spec;
        self.store.cancel_job(&local, plain).await.unwrap();
        spec.shape.snapshots = 3;
        spec.snapshots = SnapshotRange { first: 0, count: 3 };
        spec.sequence = Sequence::Contiguous;
        spec.run = RunSpec { length: 2, overlap: 1 };
        spec.algorithm = Algorithm::GapTv3d;
        spec.tile = TileSpec { size: 64, overlap: 8 };
        let new = NewJob { most_jobs: 1000, lab: local, spec, key: None };
        id(self.store.add_job(new).await.unwrap())
    }
}

fn tile(snapshot: u32, tile: u32) -> TaskKind {
    TaskKind::Tile { snapshot, snapshots: 2, tile }
}

fn assemble(snapshot: u32) -> TaskKind {
    TaskKind::Assemble { snapshot }
}

#[tokio::test]
async fn a_snapshot_waits_for_all_runs_that_hold_it() {
    let lab = Lab::new().await;
    let job = lab.submit_sequence().await;
    // The pilot decides which snapshots belong together, though the schedule is fixed.
    lab.work_on(2).await;
    assert_eq!(lab.claim().await.unwrap().kind, TaskKind::Pilot);
    lab.store.worker_ended(lab.worker, &crate::WorkerEnd::Left).await.unwrap();
    lab.work_on(3).await;
    let done = lab.work_off().await;
    let order = [
        tile(0, 0),
        tile(0, 1),
        tile(1, 0),
        tile(1, 1),
        TaskKind::White,
        assemble(0),
        assemble(1),
        assemble(2),
        TaskKind::Manifest,
    ];
    assert_eq!(done, order);
    assert_eq!(lab.state(job).await, JobState::Succeeded);
}

#[tokio::test]
async fn tiles_belong_to_all_snapshots_of_their_run() {
    let lab = Lab::new().await;
    let job = lab.submit_sequence().await;
    // Prepare, three previews, the pilot, both runs, the white level and the first snapshot.
    lab.work_on(5 + 4 + 2).await;
    let assembly = lab.claim().await.unwrap();
    assert_eq!(assembly.kind, assemble(1));
    let places = |tiles: &[crate::TileResult]| -> Vec<_> {
        tiles.iter().map(|tile| (tile.run, tile.tile)).collect()
    };
    assert_eq!(places(&assembly.step().tiles), [(0, 0), (0, 1), (1, 0), (1, 1)]);
    for (snapshot, runs) in [(0, vec![0, 0]), (1, vec![0, 0, 1, 1]), (2, vec![1, 1])] {
        let states = lab.store.tile_states(job, snapshot).await.unwrap();
        assert_eq!(states.iter().map(|tile| tile.run).collect::<Vec<_>>(), runs, "{snapshot}");
        assert!(states.iter().all(|tile| tile.snapshots == 2));
        assert!(lab.store.tile_history(job, snapshot, 1).await.unwrap().is_some());
    }
    // A damaged tile of the first run is done again before the snapshots that need it.
    lab.store.redo_tiles(&assembly.lease, &[(0, 1)]).await.unwrap();
    let done = lab.work_off().await;
    assert_eq!(done, [tile(0, 1), assemble(1), assemble(2), TaskKind::Manifest]);
    assert_eq!(lab.state(job).await, JobState::Succeeded);
}

#[tokio::test]
async fn a_sequence_that_is_taken_up_again_keeps_what_is_done() {
    let lab = Lab::new().await;
    let job = lab.submit_sequence().await;
    lab.work_on(5 + 2).await;
    let local = engine::job::Lab::local();
    lab.store.cancel_job(&local, job).await.unwrap();
    lab.store.retry_job(&local, job).await.unwrap();
    let done = lab.work_off().await;
    assert_eq!(done[..4], [tile(1, 0), tile(1, 1), TaskKind::White, assemble(0)]);
    assert_eq!(lab.state(job).await, JobState::Succeeded);
}
