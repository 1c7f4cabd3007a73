//! Notifications at the end of jobs.

use std::time::Duration;

use super::Lab;
use crate::columns::sql;
use engine::job::Timestamp;

#[tokio::test]
async fn a_taken_notification_waits_for_its_next_attempt() {
    let lab = Lab::new().await;
    for _ in 0..3 {
        let job = lab.submit(0).await;
        let due = sql!("INSERT INTO notifications (job, next_at) VALUES (?, 0)", [job]);
        due.execute(lab.store.writer().unwrap()).await.unwrap();
    }
    let take = async || {
        let later = |_| Some(Timestamp::now().after(Duration::from_secs(60)));
        lab.store.take_notifications(10, 2, later).await.unwrap()
    };
    let first = take().await;
    assert_eq!(first.iter().map(|one| one.attempts).collect::<Vec<_>>(), [1, 1], "two of a lab");
    assert_eq!(take().await.len(), 1);
    assert!(take().await.is_empty(), "results are not recorded yet");
    let job = lab.store.job_of_any_lab(first[0].job).await.unwrap();
    lab.store.not_notified(first[0].id, "refused", true).await.unwrap();
    let delivery = lab.store.delivery(&job).await.unwrap().unwrap();
    assert_eq!((delivery.attempts, delivery.next_at), (1, None), "it is given up");
}
