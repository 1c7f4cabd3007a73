//! Checks of uploads in the queue: claims, turns of labs, bounds, and reserved bytes.

use std::time::Duration;

use super::{LEASE, Lab, checked, id, new_request};
use crate::{
    Checked, Claimant, Entitlement, FoundResource, Heartbeat, Inserted, RequestKey, StoreError,
    Work, WorkerEnd,
};
use engine::intake::{Refusal, RefusalCode};
use engine::job::{
    Algorithm, CalibrationId, CalibrationRequest, MeasurementId, MeasurementRequest, Sha256,
    Submission, TaskKind, TaskProgress,
};

fn named(name: &str) -> engine::job::Lab {
    name.parse().unwrap()
}

impl Lab {
    /// Asks for a calibration of masks that this lab has sent.
    async fn ask(&self, lab: &str, key: Option<&RequestKey>) -> Inserted<CalibrationId> {
        let masks = Some(self.upload(b"other masks").await);
        let asked = CalibrationRequest { masks, ..CalibrationRequest::default() };
        let asked = new_request(Submission::Calibration(asked));
        self.store.request((&named(lab), None), &asked, key).await.unwrap()
    }

    async fn refusal(&self, lab: &str, id: CalibrationId) -> Option<Refusal> {
        self.store.find_request(&named(lab), id).await.unwrap().unwrap().refusal
    }

    async fn promised(&self) -> u64 {
        self.store.reservations().await.unwrap().total()
    }
}

#[tokio::test]
async fn checks_take_the_turns_of_their_lab() {
    let lab = Lab::new().await;
    for _ in 0..8 {
        lab.ask("busy", None).await;
    }
    lab.submit(0).await;
    let mut kinds = Vec::new();
    for _ in 0..4 {
        let task = lab.claim().await.unwrap();
        kinds.push(task.kind);
        match task.kind {
            TaskKind::Check => {
                let refusal = Refusal::new(RefusalCode::InvalidContent, "no light");
                checked(&lab.store, &task, Checked::Refused(refusal)).await;
            }
            _ => drop(lab.work(&task).await),
        }
    }
    assert!(kinds.contains(&TaskKind::Check), "{kinds:?}");
    assert!(kinds.contains(&TaskKind::Prepare), "the job of another lab waits: {kinds:?}");
}

#[tokio::test]
async fn the_light_worker_takes_checks_and_short_tasks_of_running_jobs() {
    let lab = Lab::new().await;
    let light = async || lab.store.claim_as(Claimant::Light, lab.worker, LEASE).await.unwrap();
    lab.submit(0).await;
    assert!(light().await.is_none(), "it begins no job");
    let asked = lab.ask("local", None).await.id();
    let task = light().await.unwrap();
    assert_eq!(task.kind, TaskKind::Check);
    let Work::Check(check) = &task.work else { panic!() };
    assert_eq!(CalibrationId::from(check.request.id), asked);
    lab.store.give_back(&task.lease).await.unwrap();
    // With every worker a check precedes the jobs of its lab.
    let task = lab.claim().await.unwrap();
    assert_eq!(task.kind, TaskKind::Check);
    let refusal = Refusal::new(RefusalCode::InvalidContent, "no light");
    checked(&lab.store, &task, Checked::Refused(refusal)).await;
    let prepare = lab.claim().await.unwrap();
    assert_eq!(prepare.kind, TaskKind::Prepare);
    lab.work(&prepare).await;
    let task = light().await.unwrap();
    assert_eq!(task.kind, TaskKind::Preview { snapshot: 0 });
    lab.work(&task).await;
    let task = light().await.unwrap();
    assert_eq!(task.kind, TaskKind::Preview { snapshot: 1 });
    lab.work(&task).await;
    assert!(light().await.is_none(), "tiles are left to others");
    assert_eq!(lab.claim().await.unwrap().kind.tile(), Some(0));
}

#[tokio::test]
async fn labs_take_turns_with_their_checks_by_their_shares() {
    let lab = Lab::new().await;
    for _ in 0..4 {
        lab.ask("first", None).await;
    }
    let to = Entitlement { share: Some(2.0), ..Entitlement::default() };
    lab.store.entitle(&named("second"), to).await.unwrap();
    for _ in 0..4 {
        lab.ask("second", None).await;
    }
    let mut turns = Vec::new();
    while let Some(task) = lab.store.claim(lab.worker, LEASE).await.unwrap() {
        let Work::Check(check) = &task.work else { break };
        turns.push(check.request.lab.to_string());
    }
    assert_eq!(turns.len(), 8);
    let of_second = turns[..6].iter().filter(|lab| *lab == "second").count();
    assert_eq!(of_second, 4, "{turns:?}");
}

#[tokio::test]
async fn a_lab_has_so_many_checks_and_no_more() {
    let lab = Lab::new().await;
    for _ in 0..32 {
        lab.ask("first", None).await;
    }
    let masks = Some(lab.upload(b"other masks").await);
    let asked = CalibrationRequest { masks, ..CalibrationRequest::default() };
    let asked = new_request(Submission::Calibration(asked));
    let refused = lab.store.request::<CalibrationId>((&named("first"), None), &asked, None).await;
    assert!(matches!(refused, Err(StoreError::ManyChecks { checks: 32, .. })));
    lab.ask("second", None).await;
    let task = lab.claim().await.unwrap();
    let refusal = Refusal::new(RefusalCode::InvalidContent, "no light");
    checked(&lab.store, &task, Checked::Refused(refusal)).await;
    lab.ask("first", None).await;
    let refused = lab.store.request::<CalibrationId>((&named("first"), None), &asked, None).await;
    let Err(StoreError::ManyChecks { seconds, .. }) = refused else { panic!("{refused:?}") };
    assert!((0.0..60.0).contains(&seconds), "{seconds}");
}

#[tokio::test]
async fn a_check_of_which_its_workers_die_is_given_up() {
    let lab = Lab::new().await;
    let key = RequestKey { key: "k".into(), request: Sha256::of(b"request") };
    let asked = lab.ask("local", Some(&key)).await.id();
    for attempt in 1..=5 {
        assert_eq!(lab.refusal("local", asked).await, None);
        let task = lab.claim().await.unwrap();
        assert_eq!((task.kind, task.lease.attempt), (TaskKind::Check, attempt));
        lab.store.worker_ended(lab.worker, &WorkerEnd::Killed).await.unwrap();
    }
    let refusal = lab.refusal("local", asked).await.unwrap();
    assert_eq!(refusal.code, RefusalCode::Internal);
    assert!(refusal.detail.contains("ended 5 times"), "{refusal:?}");
    assert!(lab.claim().await.is_none());
    // The key is free again.
    assert!(matches!(lab.ask("local", Some(&key)).await, Inserted::New(id) if id != asked));
}

#[tokio::test]
async fn a_check_outlives_a_lease_that_runs_out_and_a_shutdown() {
    let lab = Lab::new().await;
    let asked = lab.ask("local", None).await.id();
    let late = lab.store.claim(lab.worker, Duration::from_millis(1)).await.unwrap().unwrap();
    tokio::time::sleep(Duration::from_millis(20)).await;
    let task = lab.claim().await.unwrap();
    assert_eq!((task.lease.task, task.lease.attempt), (late.lease.task, 2));
    let refused = || Checked::Refused(Refusal::new(RefusalCode::InvalidContent, "no light"));
    assert_eq!(checked(&lab.store, &late, refused()).await, Heartbeat::Lost);
    // A server that stops again and again is not the fault of the file.
    for _ in 0..10 {
        let task = lab.claim().await.unwrap_or_else(|| task.clone());
        lab.store.give_back(&task.lease).await.unwrap();
    }
    let task = lab.claim().await.unwrap();
    assert_eq!(checked(&lab.store, &task, refused()).await, Heartbeat::Continue);
    assert_eq!(lab.refusal("local", asked).await.unwrap().detail, "no light");
}

#[tokio::test]
async fn a_check_of_a_deleted_request_stops() {
    let lab = Lab::new().await;
    let local = engine::job::Lab::local();
    let key = RequestKey { key: "k".into(), request: Sha256::of(b"request") };
    let asked = lab.ask("local", Some(&key)).await.id();
    assert_eq!(lab.ask("local", Some(&key)).await, Inserted::Before(asked));
    let task = lab.claim().await.unwrap();
    lab.store.promise(&task.lease, 1000, (1, 0)).await.unwrap();
    let masks = Sha256::of(b"other masks");
    assert!(matches!(
        lab.store.delete_upload(&local, masks).await,
        Err(StoreError::FileInUse(file)) if file == masks
    ));
    lab.store.delete(&local, asked).await.unwrap();
    let beat = lab.store.heartbeat(&task.lease, TaskProgress::START, None).await.unwrap();
    assert_eq!(beat, Heartbeat::Lost);
    let late = lab.store.promise(&task.lease, 1000, (1, 0)).await;
    assert!(matches!(late, Err(StoreError::Interrupted)));
    assert_eq!(lab.promised().await, 0);
    assert!(lab.claim().await.is_none());
    assert!(matches!(lab.ask("local", Some(&key)).await, Inserted::New(_)));
}

#[tokio::test]
async fn a_check_is_promised_room_until_it_ends() {
    let lab = Lab::new().await;
    let local = engine::job::Lab::local();
    let asked = lab.ask("local", None).await.id();
    let task = lab.claim().await.unwrap();
    let kept = lab.store.lab_bytes(&local).await.unwrap();
    let to = Entitlement { max_bytes: Some(Some(kept + 5000)), ..Entitlement::default() };
    lab.store.entitle(&local, to).await.unwrap();
    assert!(matches!(
        lab.store.promise(&task.lease, 5001, (1, 0)).await,
        Err(StoreError::Quota { needed: 5001, .. })
    ));
    let (free, _) = lab.store.dir().disk().unwrap();
    assert!(matches!(
        lab.store.promise(&task.lease, 4000, (1, 2 * free)).await,
        Err(StoreError::NoRoom { needed: 4000, .. })
    ));
    // An attempt after another is promised its own bytes, not both.
    for _ in 0..2 {
        lab.store.promise(&task.lease, 4000, (1, 0)).await.unwrap();
    }
    assert_eq!(lab.promised().await, 4000);
    assert_eq!(lab.store.lab_bytes(&local).await.unwrap(), kept + 4000);
    let other = lab.ask("local", None).await.id();
    let next = lab.claim().await.unwrap();
    assert!(matches!(
        lab.store.promise(&next.lease, 1001, (1, 0)).await,
        Err(StoreError::Quota { .. })
    ));
    for (task, asked) in [(task, asked), (next, other)] {
        let refusal = Refusal::new(RefusalCode::InvalidContent, "no light");
        checked(&lab.store, &task, Checked::Refused(refusal.clone())).await;
        assert_eq!(lab.refusal("local", asked).await, Some(refusal));
    }
    assert_eq!((lab.promised().await, lab.store.lab_bytes(&local).await.unwrap()), (0, kept));
    lab.store.delete_upload(&local, Sha256::of(b"other masks")).await.unwrap();
}

#[tokio::test]
async fn lists_hold_what_is_there_and_what_is_not_in_one_order() {
    let lab = Lab::new().await;
    let local = engine::job::Lab::local();
    let ready = lab.store.measurement(&local, lab.measurement).await.unwrap();
    let asked = MeasurementRequest::new(None, ready.facts.calibration, ready.facts.data);
    let asked = new_request(Submission::Measurement(asked));
    let mut ids = vec![lab.measurement];
    for _ in 0..2 {
        let made = lab.store.request::<MeasurementId>((&local, None), &asked, None).await;
        ids.push(made.unwrap().id());
    }
    let mut seen = Vec::new();
    let mut filter = crate::Filter::default();
    loop {
        let page = lab.store.resources(&local, filter, 2).await.unwrap();
        seen.extend(page.items.iter().map(|item| match item {
            FoundResource::Ready(measurement) => (measurement.id, true),
            FoundResource::Pending(request) => (request.id.into(), false),
        }));
        if !page.more {
            break;
        }
        filter.after = seen.last().map(|(id, _)| *id);
    }
    assert_eq!(seen, [(ids[2], false), (ids[1], false), (ids[0], true)]);
    // A pending measurement keeps its calibration and can't be used.
    let calibration = ready.facts.calibration;
    let refused = lab.store.delete(&local, calibration).await;
    assert!(matches!(refused, Err(StoreError::InUse { by: "measurements", users: 3, .. })));
    let refused = lab.store.measurement(&local, ids[1]).await;
    assert!(matches!(refused, Err(StoreError::NotReady { error: None, .. })));
    id(lab.add_algorithm(Algorithm::GapTv, 0, None, b"request").await.unwrap());
}
