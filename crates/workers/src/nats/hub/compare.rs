//! Has another worker compute a tile again, and compares the two results.

use super::core::{Core, lock};
use super::error::EventError;
use super::figures;
use super::replays::{First, Verdict};
use engine::job::{Pool, TaskId, WorkerId};
use engine::pipeline::PipelineError;
use store::RemoteTask;

impl Core {
    /// Compares a result with that of another worker, if there is one, or decides whether there is to be one.
    pub async fn compare(
        &self,
        remote: &RemoteTask,
        result: First,
        white: f32,
    ) -> Result<Verdict, EventError> {
        let task = remote.task;
        let first = lock(&self.replays).take(task);
        let Some(first) = first else {
            let pool = remote.pool.parse::<Pool>().ok();
            let another =
                pool.is_some_and(|pool| lock(&self.presence).has_another(&pool, remote.worker));
            let mut replays = lock(&self.replays);
            if another && replays.is_wanted(task) {
                replays.keep(task, result);
                return Ok(Verdict::Again);
            }
            return Ok(Verdict::Accepted(Box::new(result)));
        };
        if first.worker() == result.worker() {
            // Only where there was no other worker.
            return Ok(Verdict::Accepted(Box::new(result)));
        }
        let compared = tokio::task::spawn_blocking(move || {
            let difference = first.difference(&result, white)?;
            Ok::<_, PipelineError>((first, result.worker(), difference))
        });
        let (first, second, difference) = compared.await??;
        figures::replayed(1);
        match difference {
            None => {
                lock(&self.replays).judge(task, true);
                Ok(Verdict::Accepted(Box::new(first)))
            }
            Some(difference) => {
                tracing::error!(
                    %task, first = %first.worker(), %second, difference,
                    "two workers disagree on a tile: one of them computes wrong results"
                );
                figures::mismatched(1);
                lock(&self.replays).judge(task, false);
                Ok(Verdict::Differs(format!("worker {} disagrees: {difference}", first.worker())))
            }
        }
    }

    /// True if a worker must leave a tile to another one, because it has computed the tile once. If it is the only
    /// one of its pool, the result that it has returned is accepted.
    pub async fn leaves_to_another(
        &self,
        pool: &Pool,
        task: TaskId,
        worker: WorkerId,
    ) -> Result<bool, EventError> {
        if lock(&self.replays).first_worker(task) != Some(worker) {
            return Ok(false);
        }
        if lock(&self.presence).has_another(pool, worker) {
            return Ok(true);
        }
        let found = self.store.remote_task(task).await?;
        let Some(remote) = found.filter(|found| found.pool == pool.as_str()) else {
            return Ok(false);
        };
        let Some(first) = lock(&self.replays).take(task) else { return Ok(false) };
        tracing::warn!(%task, %worker, "no other worker is left to compute a tile a second time");
        let (completion, _) = first.into_completion()?;
        self.store.complete(&remote.lease(), completion).await?;
        self.clear(pool, task).await;
        Ok(false)
    }
}
