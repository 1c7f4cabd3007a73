//! Creates the streams and their consumers.

use std::time::Duration;

use async_nats::jetstream::ErrorCode;
use async_nats::jetstream::consumer::pull::Config as Consumer;
use async_nats::jetstream::consumer::{AckPolicy, PullConsumer};
use async_nats::jetstream::context::CreateStreamErrorKind;
use async_nats::jetstream::stream::{Config, DiscardPolicy, RetentionPolicy, StorageType};

use futures_util::TryStreamExt;

use super::connection::{ClusterError, Connection};
use super::names;
use engine::job::Pool;

/// Copies of each message if the message server is a cluster.
const REPLICAS: usize = 3;
/// Limit of a consumer's unacknowledged messages, and of the requests that wait for messages.
const AT_ONCE: i64 = 16_384;
/// Time after which an event that was not acknowledged is delivered to the hub again.
pub(super) const EVENT_WAIT: Duration = Duration::from_secs(30);
const HOUR: Duration = Duration::from_secs(3600);

fn streams() -> [Config; 4] {
    let stream = |name: &str, subject: &str| Config {
        name: name.into(),
        subjects: vec![subject.into()],
        storage: StorageType::File,
        discard: DiscardPolicy::New,
        num_replicas: 1,
        ..Config::default()
    };
    let queue = |name, subject| Config {
        retention: RetentionPolicy::WorkQueue,
        max_messages: 65_536,
        max_message_size: 512 * 1024,
        duplicate_window: Duration::from_secs(600),
        ..stream(name, subject)
    };
    let files = |name, subject, max_age| Config {
        max_messages_per_subject: 1,
        allow_direct: true,
        max_age,
        ..stream(name, subject)
    };
    [
        queue(names::TASKS, "sci.v1.task.*"),
        queue(names::EVENTS, "sci.v1.event.*"),
        files(names::INPUTS, "sci.v1.in.>", 24 * HOUR),
        files(names::OUTPUTS, "sci.v1.out.>", 6 * HOUR),
    ]
}

impl Connection {
    /// Creates missing streams. Returns the creation time of the stream of tiles, which identifies it.
    /// Errors: the server refuses, or has no quorum.
    pub(super) async fn make_streams(&self) -> Result<String, ClusterError> {
        for config in streams() {
            if self.context.get_stream(&config.name).await.is_err() {
                self.make_stream(config).await?;
            }
        }
        let tasks = self.context.get_stream(names::TASKS).await;
        let tasks = tasks.map_err(ClusterError::nats("find the stream of tiles"))?;
        Ok(tasks.cached_info().created.to_string())
    }

    async fn make_stream(&self, config: Config) -> Result<(), ClusterError> {
        let copies = Config { num_replicas: REPLICAS, ..config.clone() };
        let created = match self.context.create_stream(copies).await {
            Err(error) => match error.kind() {
                // A single server keeps one copy. A cluster without enough nodes is an error.
                CreateStreamErrorKind::JetStream(error)
                    if error.error_code() == ErrorCode::STREAM_REPLICAS_NOT_SUPPORTED =>
                {
                    self.context.create_stream(config).await
                }
                _ => Err(error),
            },
            created => created,
        };
        created.map(|_| ()).map_err(ClusterError::nats("create a stream"))
    }

    /// Creates the consumer from which all workers of a pool pull.
    /// Errors: the server refuses, or has no quorum.
    pub(super) async fn make_pool(
        &self,
        pool: &Pool,
        ack_wait: Duration,
    ) -> Result<(), ClusterError> {
        let config = Consumer {
            durable_name: Some(pool.to_string()),
            filter_subject: names::task(pool),
            ack_policy: AckPolicy::Explicit,
            ack_wait,
            max_ack_pending: AT_ONCE,
            max_waiting: AT_ONCE,
            ..Consumer::default()
        };
        let created = self.context.create_consumer_on_stream(config, names::TASKS).await;
        created.map(|_| ()).map_err(ClusterError::nats("create the consumer of a pool"))
    }

    /// Finds the consumer of a pool.
    /// Errors: it does not exist, or the credential has no right to it.
    pub(super) async fn pool(&self, pool: &Pool) -> Result<PullConsumer, ClusterError> {
        let consumer = self.context.get_consumer_from_stream(pool.as_str(), names::TASKS).await;
        consumer.map_err(ClusterError::nats("find the consumer of the pool"))
    }

    /// Removes a consumer. The next sweep creates it again at the latest; until then, pulls from it fail.
    pub(super) async fn drop_consumer(&self, stream: &str, consumer: &str) {
        if let Err(error) = self.context.delete_consumer_from_stream(consumer, stream).await {
            tracing::warn!(%error, stream, consumer, "a consumer can't be removed");
        }
    }

    /// Lists the pools with waiting events.
    /// Errors: the server refuses, or has no quorum.
    pub(super) async fn pools_with_events(&self) -> Result<Vec<Pool>, ClusterError> {
        let failed = || ClusterError::nats("read the subjects of events");
        let stream = self.context.get_stream_no_info(names::EVENTS).await;
        let stream = stream.map_err(ClusterError::nats("find the stream of events"))?;
        let subjects = stream.info_with_subjects("sci.v1.event.*").await.map_err(failed())?;
        let subjects: Vec<(String, usize)> = subjects.try_collect().await.map_err(failed())?;
        Ok(subjects.iter().filter_map(|(subject, _)| names::pool_of(subject)).collect())
    }

    /// The consumer of a pool's events. Creates it if it is missing.
    /// Errors: the server refuses, or has no quorum.
    pub(super) async fn events(&self, pool: &Pool) -> Result<PullConsumer, ClusterError> {
        let config = Consumer {
            durable_name: Some(names::events(pool)),
            filter_subject: names::event(pool),
            ack_policy: AckPolicy::Explicit,
            ack_wait: EVENT_WAIT,
            max_ack_pending: AT_ONCE,
            ..Consumer::default()
        };
        let created = self.context.create_consumer_on_stream(config, names::EVENTS).await;
        created.map_err(ClusterError::nats("create the consumer of a pool's events"))
    }
}
