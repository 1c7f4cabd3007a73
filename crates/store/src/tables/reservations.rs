//! Bytes of the disk that are reserved and not written yet, and how labs share them.

use std::collections::HashMap;

use sqlx::SqliteConnection;

use super::partials::FIRST_RESERVE;
use crate::Store;
use crate::columns::sql_as;
use crate::dir::Reserved;
use crate::error::Result;
use engine::job::{Lab, TaskState};

/// Reserved bytes of all labs.
#[derive(Debug, Clone, Default)]
pub struct Reservations {
    by_lab: HashMap<Lab, u64>,
    /// All labs.
    labs: Vec<Lab>,
}

impl Reservations {
    pub fn total(&self) -> u64 {
        self.by_lab.values().fold(0, |sum, bytes| sum.saturating_add(*bytes))
    }

    pub fn add(&mut self, lab: &Lab, bytes: u64) {
        let own = self.by_lab.entry(lab.clone()).or_default();
        *own = own.saturating_add(bytes);
    }

    pub fn seen_by(&self, lab: &Lab) -> Reserved {
        let own = self.by_lab.get(lab).copied().unwrap_or_default();
        let is_shared = self.labs.iter().chain(self.by_lab.keys()).any(|other| other != lab);
        Reserved { own, others: self.total() - own, is_shared }
    }
}

impl Store {
    /// Bytes of the disk that are reserved and not written yet.
    pub async fn reservations(&self) -> Result<Reservations> {
        reservations(&mut *self.readers.acquire().await?).await
    }
}

/// As [`Store::reservations`]: the next bytes of uploads in pieces, prepared arrays, and snapshots of jobs. Masks from
/// captures count twice: they are scaled at the end.
pub async fn reservations(connection: &mut SqliteConnection) -> Result<Reservations> {
    let found: Vec<(Lab, f64)> = sql_as!(
        "SELECT lab, sum(bytes) FROM (
             SELECT lab, min(coalesce(length - received, max(received, ?2)), max(received, ?2)) AS bytes
             FROM partials WHERE result IS NULL
             UNION ALL
             SELECT lab, prepared_bytes * iif(request ->> '$.captures' IS NULL, 1, 2)
             FROM requests WHERE prepared_bytes > 0
             UNION ALL
             SELECT lab, disk_bytes FROM jobs_by_state WHERE state = 'queued'
             UNION ALL
             SELECT lab, disk_bytes * (
                 SELECT count(*) FILTER (WHERE state <> ?1) * 1.0 / count(*)
                 FROM tasks WHERE job = jobs.id AND kind = 'assemble')
             FROM jobs WHERE state IN ('running', 'cancelling'))
         GROUP BY lab",
        [TaskState::Done, FIRST_RESERVE]
    )
    .fetch_all(&mut *connection)
    .await?;
    let labs = sql_as!("SELECT lab FROM labs").fetch_all(connection).await?;
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)] // a sum of bytes
    let by_lab = found.into_iter().map(|(lab, bytes)| (lab, bytes as u64)).collect();
    Ok(Reservations { by_lab, labs })
}

#[cfg(test)]
mod tests {
    use super::{Reservations, Reserved};

    #[test]
    fn a_lab_sees_its_bytes_and_those_of_others() {
        let (a, b) = ("a".parse().unwrap(), "b".parse().unwrap());
        let mut all = Reservations::default();
        all.add(&a, 10);
        assert_eq!(all.seen_by(&a), Reserved { own: 10, others: 0, is_shared: false });
        all.add(&b, 5);
        assert_eq!(all.seen_by(&a), Reserved { own: 10, others: 5, is_shared: true });
        assert_eq!(all.total(), 15);
    }
}
