//! A connection that fails when its client reads the answer too slowly.
//!
//! The body of an answer is not polled while its client reads nothing, so the limit is in the connection. Time counts only
//! while bytes wait for the client; an idle connection stays open.

use std::io;
use std::pin::Pin;
use std::task::{Context, Poll};
use std::time::Duration;

use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::time::Sleep;

/// The slowest allowed client: it reads `bytes` within `time` while more bytes wait.
#[derive(Debug, Clone, Copy)]
pub(super) struct LeastRate {
    /// 0 stands for no limit.
    pub(super) bytes: u64,
    pub(super) time: Duration,
}

#[derive(Debug)]
pub(super) struct WriteDeadline<S> {
    stream: S,
    least: LeastRate,
    /// Set while bytes wait for the client.
    waiting: Option<Waiting>,
}

#[derive(Debug)]
struct Waiting {
    /// Bytes that the client read since the wait began.
    bytes_read: u64,
    deadline: Pin<Box<Sleep>>,
}

impl<S> WriteDeadline<S> {
    pub(super) fn new(stream: S, least: LeastRate) -> Self {
        Self { stream, least, waiting: None }
    }

    /// Updates the wait after a write.
    ///
    /// Errors: `TimedOut` if the client read too little since the wait began.
    fn check(
        &mut self,
        cx: &mut Context<'_>,
        written: Poll<io::Result<usize>>,
    ) -> Poll<io::Result<usize>> {
        let LeastRate { bytes, time } = self.least;
        match &written {
            Poll::Ready(Ok(count)) => {
                if let Some(waiting) = &mut self.waiting {
                    waiting.bytes_read += *count as u64;
                    if waiting.bytes_read >= bytes {
                        self.waiting = None;
                    }
                }
            }
            Poll::Pending if bytes > 0 => {
                let start =
                    || Waiting { bytes_read: 0, deadline: Box::pin(tokio::time::sleep(time)) };
                let waiting = self.waiting.get_or_insert_with(start);
                if waiting.deadline.as_mut().poll(cx).is_ready() {
                    let (bytes_read, seconds) = (waiting.bytes_read, time.as_secs());
                    tracing::info!(
                        bytes_read,
                        seconds,
                        "an answer was aborted because its client reads too slowly"
                    );
                    return Poll::Ready(Err(io::ErrorKind::TimedOut.into()));
                }
            }
            Poll::Pending | Poll::Ready(Err(_)) => {}
        }
        written
    }
}

impl<S: AsyncWrite + Unpin> AsyncWrite for WriteDeadline<S> {
    fn poll_write(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        bytes: &[u8],
    ) -> Poll<io::Result<usize>> {
        let written = Pin::new(&mut self.stream).poll_write(cx, bytes);
        self.check(cx, written)
    }

    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        parts: &[io::IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        let written = Pin::new(&mut self.stream).poll_write_vectored(cx, parts);
        self.check(cx, written)
    }

    fn is_write_vectored(&self) -> bool {
        self.stream.is_write_vectored()
    }

    /// Ends the wait: once all bytes are flushed, none wait for the client.
    fn poll_flush(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        let flushed = Pin::new(&mut self.stream).poll_flush(cx);
        if flushed.is_ready() {
            self.waiting = None;
        }
        flushed
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_shutdown(cx)
    }
}

impl<S: AsyncRead + Unpin> AsyncRead for WriteDeadline<S> {
    fn poll_read(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_read(cx, buffer)
    }
}

#[cfg(test)]
mod tests {
    use std::io::ErrorKind;
    use std::time::{Duration, Instant};

    use tokio::io::{AsyncReadExt, AsyncWriteExt, duplex};
    use tokio::time::sleep;

    use super::{LeastRate, WriteDeadline};

    /// Far below the rates of the fast clients, which a busy machine slows down.
    const SECOND: LeastRate = LeastRate { bytes: 2_000, time: Duration::from_secs(1) };

    /// Sends 60,000 bytes to a client that reads `bytes` every 50 ms.
    async fn send_to_client(bytes: usize, least: LeastRate) -> (std::io::Result<()>, Duration) {
        let (stream, mut client) = duplex(1000);
        let reading = tokio::spawn(async move {
            let mut buffer = vec![0; bytes];
            while client.read_exact(&mut buffer).await.is_ok() {
                sleep(Duration::from_millis(50)).await;
            }
        });
        let mut stream = WriteDeadline::new(stream, least);
        let start = Instant::now();
        let sent = stream.write_all(&[1; 60_000]).await;
        reading.abort();
        (sent, start.elapsed())
    }

    #[tokio::test]
    async fn an_answer_to_a_slow_client_is_aborted() {
        let (sent, took) = send_to_client(50, SECOND).await;
        assert_eq!(sent.unwrap_err().kind(), ErrorKind::TimedOut);
        assert!((1.0..5.0).contains(&took.as_secs_f64()), "{took:?}");
        let (sent, took) = send_to_client(1000, SECOND).await;
        sent.unwrap();
        assert!(took > 2 * SECOND.time, "several periods passed: {took:?}");
        let (sent, _) = send_to_client(1000, LeastRate { bytes: 0, ..SECOND }).await;
        sent.unwrap();
    }

    #[tokio::test]
    async fn idle_time_does_not_count() {
        let (stream, mut client) = duplex(1000);
        let mut stream = WriteDeadline::new(stream, SECOND);
        for _ in 0..3 {
            // The answer exceeds the buffer, so bytes wait for the client.
            let answer = async {
                stream.write_all(&[1; 1500]).await.unwrap();
                stream.flush().await.unwrap();
            };
            let read = async {
                sleep(Duration::from_millis(50)).await;
                client.read_exact(&mut [0; 1500]).await.unwrap();
            };
            tokio::join!(answer, read);
            sleep(Duration::from_millis(700)).await;
        }
        let error = stream.write_all(&[1; 1500]).await.unwrap_err();
        assert_eq!(error.kind(), ErrorKind::TimedOut);
    }
}
