//! Has another worker compute a tile again, and compares the two results.

use super::core::{Core, lock};
use super::error::HubError;
use super::figures;
use super::replays::{First, Verdict};
use engine::job::{Pool, TaskId, WorkerId};
use engine::pipeline::PipelineError;
use store::RemoteTask;

impl Core {
    /// Compares a result with that of another worker. Without one, decides whether another worker should compute it.
    pub async fn compare(
        &self,
        remote: &RemoteTask,
        result: First,
        white: f32,
    ) -> Result<Verdict, HubError> {
        let task = remote.task;
        let first = lock(&self.replays).take(task);
        let Some(first) = first else {
            let pool = remote.pool.parse::<Pool>().ok();
            let has_another =
                pool.is_some_and(|pool| lock(&self.presence).has_another(&pool, remote.worker));
            let mut replays = lock(&self.replays);
            if has_another && replays.is_wanted(task) {
                replays.keep(task, result);
                return Ok(Verdict::Again);
            }
            return Ok(Verdict::Accepted(Box::new(result)));
        };
        if first.worker() == result.worker() {
            // This happens if the pool has no other worker.
            return Ok(Verdict::Accepted(Box::new(result)));
        }
        let compared = tokio::task::spawn_blocking(move || {
            let difference = first.difference(&result, white)?;
            Ok::<_, PipelineError>((first, result.worker(), difference))
        });
        let (first, second, difference) = compared.await??;
        figures::count(figures::REPLAYED, 1);
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
                figures::count(figures::MISMATCHED, 1);
                lock(&self.replays).judge(task, false);
                Ok(Verdict::Differs(format!("worker {} disagrees: {difference}", first.worker())))
            }
        }
    }

    /// True if a worker must leave a tile to another one, because it has computed the tile before. If it is the only
    /// worker of its pool, its first result is accepted.
    pub async fn leaves_to_another(
        &self,
        pool: &Pool,
        task: TaskId,
        worker: WorkerId,
    ) -> Result<bool, HubError> {
        if lock(&self.replays).first_worker(task) != Some(worker) {
            return Ok(false);
        }
        if lock(&self.presence).has_another(pool, worker) {
            return Ok(true);
        }
        let remote = self.store.remote_task(task).await?;
        let Some(remote) = remote.filter(|remote| remote.pool == pool.as_str()) else {
            return Ok(false);
        };
        let Some(first) = lock(&self.replays).take(task) else { return Ok(false) };
        tracing::warn!(%task, %worker, "no other worker is left to verify a tile; its result is accepted");
        let (completion, _) = first.into_completion()?;
        self.store.complete(&remote.lease(), completion).await?;
        self.clear(pool, task).await;
        Ok(false)
    }
}
