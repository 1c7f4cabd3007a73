//! Tiles that are out with other machines.

use std::time::Duration;

use super::{Lab, WorkerId};
use crate::{Begun, Claimant, MessagePlace};

#[tokio::test]
async fn a_tile_that_waits_elsewhere_does_not_run() {
    let lab = Lab::new().await;
    let job = lab.submit(0).await;
    // The tasks before the tiles.
    lab.work_on(3).await;
    let hub = WorkerId::new();
    let pool = Claimant::Pool("gpu");
    let out = lab.store.claim_as(pool, hub, Duration::ZERO).await.unwrap().unwrap().lease;
    let place = MessagePlace { stream: "made today".into(), seq: 1 };
    lab.store.remote_published(&out, &place).await.unwrap();
    let seen = async || {
        let job = lab.store.job(&engine::job::Lab::local(), job).await.unwrap();
        let running = lab.store.progress(&job).await.unwrap().tiles_running;
        (running, lab.store.last_change().await.unwrap())
    };
    let (running, waiting) = seen().await;
    assert_eq!(running, 0, "no worker has it in hand");
    let begun = lab.store.remote_begin(out.task, "gpu", out.attempt, 1, 1, lab.worker).await;
    assert_eq!(begun.unwrap(), Begun::Go(1, false));
    let (running, begun) = seen().await;
    assert_eq!(running, 1);
    let changes = lab.store.changes(waiting).await.unwrap();
    assert_eq!(changes.last, begun);
    let changed = changes.items.unwrap();
    assert_eq!((changed.len(), &changed[0].id), (1, &job.to_string()), "listeners learn of it");
}
