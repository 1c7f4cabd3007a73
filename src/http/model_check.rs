//! The check of a network, in a process of its own: it runs native code on what a stranger has sent,
//! and may crash, hang, or take all memory.

use std::path::{Path, PathBuf};
use std::process::{ExitStatus, Stdio};
use std::time::Duration;

use tokio::process::Command;

use super::error::{ApiError, Code, Result};
use super::shares::Turns;
use crate::config::{EngineArguments, ServeArguments};
use engine::job::{Lab, ModelFacts, ModelVerdict, without_paths};
use store::NewCalibration;

/// The longest check: loading the network and one run.
const TIME: Duration = Duration::from_secs(300);

/// Characters of a reason that are told.
const REASON: usize = 2000;

/// How a check is started.
#[derive(Debug)]
pub(super) struct Checker {
    /// This program; none if the operating system does not say where it is.
    program: Option<PathBuf>,
    engine: EngineArguments,
    memory_bytes: u64,
    /// Two at a time, of two labs; not with the checks of other files, which would wait for minutes.
    turns: Turns,
}

impl Checker {
    pub(super) fn new(settings: &ServeArguments) -> Self {
        Self {
            program: std::env::current_exe().ok(),
            engine: settings.engine.clone(),
            memory_bytes: settings.worker_memory_bytes,
            turns: Turns::new(2, 4),
        }
    }

    fn command(&self, file: &Path, masks: &NewCalibration) -> Option<Command> {
        let mut command = Command::new(self.program.as_ref()?);
        command.arg("check-model").arg(file);
        // Of a mosaic each of the four sub-images goes through the network.
        let step = if masks.mosaic.is_some() { 2 } else { 1 };
        let (height, width) = (masks.height / step, masks.width / step);
        for (name, value) in [("--frames", masks.frames), ("--height", height), ("--width", width)]
        {
            command.arg(name).arg(value.to_string());
        }
        // A GPU's driver maps far more than it uses.
        if self.engine.device == "cpu" {
            command.arg("--memory-bytes").arg(self.memory_bytes.to_string());
        }
        command.arg("--device").arg(&self.engine.device);
        if let Some(library) = &self.engine.onnxruntime {
            command.arg("--onnxruntime").arg(library);
        }
        if self.engine.unconfined {
            command.arg("--unconfined");
        }
        command.stdin(Stdio::null()).kill_on_drop(true);
        Some(command)
    }

    /// Checks whether an upload is a network for these masks, and runs it once, when it is the lab's turn.
    /// Errors: 422 with what it has and what is needed; 503 if no network can be run here.
    pub(super) async fn check(
        &self,
        lab: &Lab,
        file: &Path,
        masks: &NewCalibration,
    ) -> Result<ModelFacts> {
        let unavailable = |why: &str| ApiError::new(Code::Unavailable, why);
        let _turn = self.turns.take(lab).await?;
        let mut command = self
            .command(file, masks)
            .ok_or_else(|| unavailable("the service can't start the check of a network"))?;
        // A network's names are any text of any length.
        let cut = |why: String| without_paths(&why).chars().take(REASON).collect::<String>();
        let refused = |why: String| ApiError::new(Code::InvalidContent, cut(why)).at("/file");
        let output = match tokio::time::timeout(TIME, command.output()).await {
            Ok(output) => output.map_err(|error| ApiError::internal(&error))?,
            Err(_) => {
                let seconds = TIME.as_secs();
                return Err(refused(format!("one run of the network takes more than {seconds} s")));
            }
        };
        if let Some(how) = killed(output.status) {
            return Err(refused(format!(
                "the network ended the process that tried it ({how}); it may take {} MiB of memory",
                self.memory_bytes >> 20
            )));
        }
        match serde_json::from_slice(&output.stdout) {
            Ok(ModelVerdict::Fits(facts)) => Ok(facts),
            Ok(ModelVerdict::Refused(why)) => Err(refused(why)),
            Err(_) => {
                let said = String::from_utf8_lossy(&output.stderr);
                tracing::error!(%said, status = %output.status, "a network can't be checked");
                Err(unavailable("the service can't run networks now; its log says why"))
            }
        }
    }
}

/// The signal that ended a process, if one did.
fn killed(status: ExitStatus) -> Option<String> {
    use std::os::unix::process::ExitStatusExt;
    status.signal().map(|_| status.to_string())
}
