//! Runs each network of a user in a separate process (`sci-recon run-model`). Native code handles a stranger's
//! file there: the process sees no lab's files, and a crash does not end the worker.
//!
//! The worker sends the length and the bytes of the ONNX file. For each run it sends the sides B, H and W, the
//! measurement and the masks. The process answers with a line of JSON, [`Answer`]; the frames follow
//! [`Answer::Frames`]. Numbers have this machine's byte order.

use std::ffi::OsString;
use std::io::{self, BufRead, BufReader, Read, Write};
use std::path::PathBuf;
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};
use std::sync::mpsc::{self, RecvTimeoutError};
use std::time::Duration;

use ndarray::{Array2, Array3, ArrayView2, ArrayView3};
use serde::{Deserialize, Serialize};

use engine::job::{Sha256, shortened_reason};
use engine::pipeline::PipelineError;
use engine::pipeline::networks::{ModelFile, NetworkSource};
use engine::pipeline::progress::Monitor;
use engine::pipeline::usage::{cpu_seconds_of, kills_for_memory, peak_rss_of};
use reconstruction::ReconError;
use reconstruction::learned::{SnapshotNetwork, all_finite};

/// Time between checks for a cancellation and of the memory in use.
const POLL: Duration = Duration::from_millis(100);
/// Longest line of an answer, in bytes.
const MAX_LINE: u64 = 1 << 16;

#[derive(Debug, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
enum Answer {
    Loaded,
    Frames,
    Failed(String),
}

/// The command lines that run and check networks.
#[derive(Debug, Clone)]
pub struct ModelCommand {
    /// Path of this program.
    pub program: PathBuf,
    /// The arguments that run a network.
    pub run: Vec<OsString>,
    /// The arguments that check a network, without its file and the size of the masks.
    pub check: Vec<OsString>,
    /// Memory limit of the process in bytes.
    pub memory_bytes: Option<u64>,
    /// The execution provider of the network, for records.
    pub provider: &'static str,
}

/// The process of the network that was used last.
pub(super) struct ModelProcesses {
    command: ModelCommand,
    running: Option<ModelProcess>,
}

impl ModelProcesses {
    pub(super) fn new(command: ModelCommand) -> Self {
        Self { command, running: None }
    }

    /// The command lines that run and check networks.
    pub(super) fn command(&self) -> &ModelCommand {
        &self.command
    }

    /// Returns a process with this network, and ends the process of any other: memory is planned for one at a time.
    /// Without a file, no process remains.
    pub(super) fn only(
        &mut self,
        file: Option<&ModelFile>,
        monitor: &Monitor,
    ) -> Result<Option<&mut ModelProcess>, PipelineError> {
        let running = self.running.take();
        let Some(file) = file else { return Ok(None) };
        let running = running.filter(|process| process.model == file.sha256());
        let process = match running.and_then(ModelProcess::if_alive) {
            Some(process) => process,
            None => ModelProcess::start(&self.command, file, monitor)?,
        };
        Ok(Some(self.running.insert(process)))
    }
}

/// A process with a loaded network. It is killed when this is dropped.
pub(super) struct ModelProcess {
    model: Sha256,
    child: Child,
    input: ChildStdin,
    output: BufReader<ChildStdout>,
    /// Memory limit in bytes, and the largest use that was observed.
    memory: (Option<u64>, u64),
    /// The kernel's count of out-of-memory kills when the process started.
    kills: Option<u64>,
    /// See [`Self::bill`].
    billed: f64,
}

impl ModelProcess {
    fn start(
        command: &ModelCommand,
        file: &ModelFile,
        monitor: &Monitor,
    ) -> Result<Self, PipelineError> {
        let content = file.content()?;
        let failed = |error: io::Error| {
            ReconError::Runtime(format!("the process of a network can't be started: {error}"))
        };
        let mut child = Command::new(&command.program)
            .args(&command.run)
            // The arguments carry all settings.
            .env_remove("SCI_RECON_CONFIG")
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .map_err(failed)?;
        let pipes = child.stdin.take().zip(child.stdout.take());
        let (input, output) = pipes.ok_or_else(|| failed(io::ErrorKind::BrokenPipe.into()))?;
        let mut process = Self {
            model: file.sha256(),
            child,
            input,
            output: BufReader::new(output),
            memory: (command.memory_bytes, 0),
            kills: kills_for_memory(),
            billed: 0.0,
        };
        process.ask(monitor, |input, output| {
            input.write_all(&(content.len() as u64).to_ne_bytes())?;
            input.write_all(&content)?;
            answer(output)
        })?;
        Ok(process)
    }

    /// Returns the process if it still runs.
    fn if_alive(mut self) -> Option<Self> {
        matches!(self.child.try_wait(), Ok(None)).then_some(self)
    }

    /// Returns the processor time in seconds since the last call, and the largest resident memory in bytes.
    pub(super) fn bill(&mut self) -> (f64, u64) {
        let process = self.child.id();
        let now = cpu_seconds_of(process);
        (now - std::mem::replace(&mut self.billed, now), peak_rss_of(process))
    }

    /// The network of the process. Stopping `monitor` ends its runs.
    pub(super) fn watched<'a>(&'a mut self, monitor: &'a Monitor) -> impl SnapshotNetwork + 'a {
        Watched { process: self, monitor }
    }

    /// Exchanges messages with the process, and kills it if the monitor is stopped.
    fn ask<T>(
        &mut self,
        monitor: &Monitor,
        exchange: impl FnOnce(
            &mut ChildStdin,
            &mut BufReader<ChildStdout>,
        ) -> io::Result<Result<T, String>>,
    ) -> Result<T, PipelineError> {
        let Self { child, input, output, memory: (_, peak), .. } = self;
        let (done, ended) = mpsc::channel::<()>();
        let exchanged = std::thread::scope(|scope| {
            scope.spawn(move || {
                // Neither native code nor a pipe can be asked to stop.
                while ended.recv_timeout(POLL) == Err(RecvTimeoutError::Timeout) {
                    *peak = peak_rss_of(child.id()).max(*peak);
                    if monitor.stopped() {
                        let _ = child.kill();
                    }
                }
            });
            let exchanged = exchange(input, output);
            drop(done);
            exchanged
        });
        monitor.check()?;
        match exchanged {
            Ok(Ok(value)) => Ok(value),
            Ok(Err(reason)) => Err(ReconError::Runtime(reason).into()),
            Err(error) => Err(ReconError::Runtime(self.crash_report(&error)).into()),
        }
    }

    /// Explains why the process does not answer.
    fn crash_report(&mut self, error: &io::Error) -> String {
        // The process may have closed its pipes and still run.
        let _ = self.child.kill();
        let status = match self.child.wait() {
            Ok(status) => status.to_string(),
            Err(_) => error.to_string(),
        };
        let (limit, peak) = self.memory;
        let out_of_memory = match kills_for_memory() > self.kills {
            true => "; the machine had no memory left for it",
            false => "",
        };
        let limit =
            limit.map_or_else(String::new, |limit| format!(", its limit is {} MiB", limit >> 20));
        format!(
            "the network crashed the process that ran it ({status}){out_of_memory}; the process used {} \
            MiB of memory{limit}",
            peak >> 20
        )
    }
}

impl Drop for ModelProcess {
    fn drop(&mut self) {
        // Fails if the process has already ended.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

struct Watched<'a> {
    process: &'a mut ModelProcess,
    monitor: &'a Monitor,
}

impl SnapshotNetwork for Watched<'_> {
    fn frames(
        &mut self,
        y: ArrayView2<'_, f32>,
        masks: ArrayView3<'_, f32>,
    ) -> Result<Array3<f32>, ReconError> {
        let (frames, height, width) = masks.dim();
        let ran = self.process.ask(self.monitor, |input, output| {
            let sides = [frames, height, width].map(|side| side as u64);
            input.write_all(bytemuck::cast_slice(&sides))?;
            for values in [y.as_slice(), masks.as_slice()] {
                let values = values.ok_or(io::ErrorKind::InvalidInput)?;
                input.write_all(bytemuck::cast_slice(values))?;
            }
            if let Err(reason) = answer(output)? {
                return Ok(Err(reason));
            }
            let mut frames = Array3::zeros(masks.raw_dim());
            if let Some(values) = frames.as_slice_mut() {
                output.read_exact(bytemuck::cast_slice_mut(values))?;
            }
            Ok(Ok(frames))
        });
        let frames = ran.map_err(|error| match error {
            PipelineError::Stopped => ReconError::Cancelled,
            other => ReconError::Runtime(other.to_string()),
        })?;
        // The frames come from a stranger's network.
        all_finite(&frames)?;
        Ok(frames)
    }
}

/// Reads an answer. The inner error is the reason that the network gave.
fn answer(output: &mut impl BufRead) -> io::Result<Result<(), String>> {
    let mut line = String::new();
    output.by_ref().take(MAX_LINE).read_line(&mut line)?;
    match serde_json::from_str(&line) {
        Ok(Answer::Loaded | Answer::Frames) => Ok(Ok(())),
        Ok(Answer::Failed(reason)) => Ok(Err(reason)),
        Err(error) => Err(io::Error::new(io::ErrorKind::InvalidData, error)),
    }
}

/// Runs in the network's process: reads tasks from standard input until it ends, and answers on standard output.
/// Errors: standard output is closed.
pub fn answer_worker(source: &NetworkSource) -> io::Result<()> {
    let (sender, tasks) = mpsc::sync_channel(0);
    // The input ends when the worker dies. Then this process ends too, whatever the network is doing.
    std::thread::spawn(move || {
        let _ = read(&mut io::stdin().lock(), &sender);
        std::process::exit(0);
    });
    let mut network = None;
    let mut output = io::stdout().lock();
    for task in tasks {
        let (answer, frames) = match (task, &mut network) {
            (Task::Load(content), network) => match source.end_to_end(&content) {
                Ok(loaded) => {
                    *network = Some(loaded);
                    (Answer::Loaded, None)
                }
                Err(error) => (Answer::Failed(shortened_reason(&error.to_string())), None),
            },
            (Task::Run(y, masks), Some(network)) => match network.frames(y.view(), masks.view()) {
                Ok(frames) => (Answer::Frames, Some(frames)),
                Err(error) => (Answer::Failed(shortened_reason(&error.to_string())), None),
            },
            (Task::Run(..), None) => (Answer::Failed("no network is loaded".into()), None),
        };
        serde_json::to_writer(&mut output, &answer)?;
        output.write_all(b"\n")?;
        if let Some(frames) = frames.as_ref().and_then(|frames| frames.as_slice()) {
            output.write_all(bytemuck::cast_slice(frames))?;
        }
        output.flush()?;
    }
    Ok(())
}

enum Task {
    Load(Vec<u8>),
    Run(Array2<f32>, Array3<f32>),
}

/// Reads the network and then the runs that the worker sends, until the input ends.
fn read(input: &mut impl Read, tasks: &mpsc::SyncSender<Task>) -> io::Result<()> {
    let mut length = [0; 1];
    input.read_exact(bytemuck::cast_slice_mut::<u64, u8>(&mut length))?;
    let mut content = Vec::new();
    input.by_ref().take(length[0]).read_to_end(&mut content)?;
    let closed = |_| io::Error::from(io::ErrorKind::BrokenPipe);
    tasks.send(Task::Load(content)).map_err(closed)?;
    loop {
        let mut sides = [0; 3];
        input.read_exact(bytemuck::cast_slice_mut::<u64, u8>(&mut sides))?;
        let [frames, height, width] = sides.map(|side| usize::try_from(side).unwrap_or(usize::MAX));
        let mut y = Array2::zeros((height, width));
        let mut masks = Array3::zeros((frames, height, width));
        for values in [y.as_slice_mut(), masks.as_slice_mut()].into_iter().flatten() {
            input.read_exact(bytemuck::cast_slice_mut::<f32, u8>(values))?;
        }
        tasks.send(Task::Run(y, masks)).map_err(closed)?;
    }
}

#[cfg(test)]
mod tests {
    use std::time::{Duration, Instant};

    use ndarray::{Array2, Array3};

    use super::{ModelCommand, ModelProcesses};
    use engine::pipeline::PipelineError;
    use engine::pipeline::networks::ModelFile;
    use engine::pipeline::progress::Monitor;
    use reconstruction::ReconError;
    use reconstruction::learned::SnapshotNetwork;

    /// Runs a shell script in place of a network, after the length and the 8 bytes of the file were read.
    fn run(script: &str, monitor: &Monitor) -> Result<Array3<f32>, PipelineError> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("network.onnx");
        std::fs::write(&path, "8 bytes.").unwrap();
        let run = ["-c".into(), format!("head -c 16 >/dev/null; {script}").into()].into();
        let (check, memory_bytes) = (Vec::new(), Some(512 << 20));
        let command = ModelCommand {
            program: "sh".into(),
            run,
            check,
            memory_bytes,
            provider: "CPUExecutionProvider",
        };
        let mut processes = ModelProcesses::new(command);
        let file = ModelFile::open(&path).unwrap();
        let process = processes.only(Some(&file), monitor)?.unwrap();
        let masks = Array3::ones((2, 2, 2));
        Ok(process.watched(monitor).frames(Array2::ones((2, 2)).view(), masks.view())?)
    }

    /// Answers that the network is loaded, and reads the sides, the measurement and the masks of a run.
    const READ_RUN: &str = r#"echo '"loaded"'; head -c 72 >/dev/null; "#;

    #[test]
    fn a_network_returns_its_frames() {
        let script = format!("{READ_RUN} echo '\"frames\"'; head -c 32 /dev/zero; exec cat");
        assert_eq!(run(&script, &Monitor::default()).unwrap(), Array3::<f32>::zeros((2, 2, 2)));
    }

    #[test]
    fn a_bad_answer_is_reported_with_its_cause() {
        for (script, expected) in [
            ("exit 3".to_owned(), "exit status: 3"),
            ("kill -ABRT $$".to_owned(), "SIGABRT"),
            ("echo '{\"failed\":\"no network\"}'; exec cat".to_owned(), "no network"),
            ("echo '{'; exec cat".to_owned(), "limit is 512 MiB"),
            ("head -c 100000 /dev/zero; exec cat".to_owned(), "crashed the process"),
            (format!("{READ_RUN} kill -SEGV $$"), "SIGSEGV"),
            (format!("{READ_RUN} echo '\"frames\"'; head -c 31 /dev/zero"), "exit status: 0"),
            (
                format!(
                    "{READ_RUN} echo '\"frames\"'; head -c 32 /dev/zero | tr '\\0' '\\377'; exec cat"
                ),
                "finite",
            ),
        ] {
            let error = run(&script, &Monitor::default()).unwrap_err().to_string();
            assert!(error.contains(expected), "{script}: {error}");
        }
    }

    #[test]
    fn stopping_the_monitor_ends_a_run() {
        for script in ["exec sleep 60".to_owned(), format!("{READ_RUN} exec sleep 60")] {
            let (monitor, start) = (Monitor::default(), Instant::now());
            let ended = std::thread::scope(|scope| {
                scope.spawn(|| {
                    std::thread::sleep(Duration::from_millis(300));
                    monitor.stop();
                });
                run(&script, &monitor)
            });
            assert!(matches!(
                ended,
                Err(PipelineError::Stopped | PipelineError::Recon(ReconError::Cancelled))
            ));
            assert!(start.elapsed() < Duration::from_secs(30));
        }
    }
}
