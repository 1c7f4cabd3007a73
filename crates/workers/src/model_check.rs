//! Checks a network in a separate process (`sci-recon check-model`). A stranger's file reaches native code, which
//! may crash, hang, or take all memory.

use std::io::Read;
use std::os::unix::process::ExitStatusExt;
use std::path::Path;
use std::process::{Command, ExitStatus, Stdio};
use std::time::{Duration, Instant};

use super::model_process::ModelCommand;
use super::transport::TaskError;
use engine::intake::{IntakeError, Refusal, RefusalCode};
use engine::job::{ModelFacts, ModelVerdict, TaskStage, shortened_reason, without_paths};
use engine::pipeline::progress::Monitor;
use store::NewCalibration;

/// Time between polls of the process.
const POLL: Duration = Duration::from_millis(20);
/// Number of bytes that are kept of each output of the process. A verdict has a few kilobytes.
const MAX_OUTPUT: u64 = 1 << 20;

/// The exit status and the first [`MAX_OUTPUT`] bytes of each output of a process.
struct Exit {
    status: ExitStatus,
    stdout: Vec<u8>,
    stderr: Vec<u8>,
}

/// Checks whether an upload is a network for these masks, and runs it once. Kills the process at `deadline`.
/// Errors: the process can't be started, or the check was stopped.
pub(super) fn run(
    command: &ModelCommand,
    file: &Path,
    masks: &NewCalibration,
    deadline: Instant,
    monitor: &Monitor,
) -> Result<Result<ModelFacts, Refusal>, TaskError> {
    let start = Instant::now();
    let exit = run_until(command_line(command, file, masks), deadline, monitor)
        .map_err(|error| TaskError::Transport(error.into()))?;
    let refused = |why: String| {
        let why = without_paths(&shortened_reason(&why));
        Ok(Err(Refusal::new(RefusalCode::InvalidContent, why).at("/file")))
    };
    let Some(Exit { status, stdout, stderr }) = exit else {
        if monitor.stopped() {
            return Err(IntakeError::Stopped.into());
        }
        let seconds = start.elapsed().as_secs();
        return refused(format!("one run of the network takes more than {seconds} s"));
    };
    if status.signal().is_some() {
        let limit = match command.memory_bytes {
            Some(bytes) => format!("; it may take {} MiB of memory", bytes >> 20),
            None => String::new(),
        };
        return refused(format!(
            "the network crashed the process that checked it ({status}){limit}"
        ));
    }
    match serde_json::from_slice(&stdout) {
        Ok(ModelVerdict::Fits(facts)) => Ok(Ok(facts)),
        Ok(ModelVerdict::Refused(why)) => refused(why),
        Err(_) => {
            let output = shortened_reason(&String::from_utf8_lossy(&stderr));
            tracing::error!(%output, %status, "a network can't be checked");
            let detail = "the service can't run networks now; its log has the reason";
            Ok(Err(Refusal::new(RefusalCode::Unavailable, detail)))
        }
    }
}

fn command_line(model: &ModelCommand, file: &Path, masks: &NewCalibration) -> Command {
    let mut command = Command::new(&model.program);
    command.args(&model.check).arg(file);
    // Each of the four sub-images of a mosaic goes through the network.
    let step = if masks.mosaic.is_some() { 2 } else { 1 };
    let (height, width) = (masks.height / step, masks.width / step);
    for (name, value) in [("--frames", masks.frames), ("--height", height), ("--width", width)] {
        command.arg(name).arg(value.to_string());
    }
    // The process ends when its standard input closes, which happens at the latest when this process ends.
    command.arg("--supervised").env_remove("SCI_RECON_CONFIG");
    command.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::piped());
    command
}

/// Runs a process to its end. Returns `None` if it was killed at the deadline or because the check was stopped.
fn run_until(
    mut command: Command,
    deadline: Instant,
    monitor: &Monitor,
) -> std::io::Result<Option<Exit>> {
    let mut child = command.spawn()?;
    let (mut output, mut errors) = (child.stdout.take(), child.stderr.take());
    std::thread::scope(|scope| {
        let read = |pipe: Option<&mut dyn Read>| {
            let mut bytes = Vec::new();
            if let Some(mut pipe) = pipe {
                // The bytes before a read error suffice. The rest is read too, so that the process is not blocked.
                let _ = (&mut pipe).take(MAX_OUTPUT).read_to_end(&mut bytes);
                let _ = std::io::copy(&mut pipe, &mut std::io::sink());
            }
            bytes
        };
        let stdout = scope.spawn(move || read(output.as_mut().map(|pipe| pipe as _)));
        let stderr = scope.spawn(move || read(errors.as_mut().map(|pipe| pipe as _)));
        let status = loop {
            match child.try_wait() {
                Ok(None) if monitor.stopped() || Instant::now() >= deadline => break Ok(None),
                Ok(None) => {
                    // The deadline bounds the run, so silence is no stall.
                    monitor.reach(TaskStage::Reading, 0.0);
                    std::thread::sleep(POLL);
                }
                ended => break ended,
            }
        };
        if !matches!(status, Ok(Some(_))) {
            let _ = child.kill();
            let _ = child.wait();
        }
        let bytes =
            |thread: std::thread::ScopedJoinHandle<'_, Vec<u8>>| thread.join().unwrap_or_default();
        let (stdout, stderr) = (bytes(stdout), bytes(stderr));
        Ok(status?.map(|status| Exit { status, stdout, stderr }))
    })
}
