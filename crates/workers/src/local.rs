//! The transport of a worker on the machine of the store.

use std::ops::Range;
use std::sync::Arc;
use std::time::Duration;

use ndarray::ArrayView3;
use serde::de::DeserializeOwned;
use serde_json::Value;
use tokio::runtime::Handle;
use tokio::sync::Mutex;

use super::transport::{
    Check, Claim, Done, LEASE, Output, TaskError, TaskInput, TileTask, Transport, TransportError,
};
use engine::job::{Inputs, ModelRecord, Registered, Sha256, TaskKind, TaskProgress, WorkerId};
use engine::pipeline::PipelineError;
use engine::pipeline::arrays::Arrays;
use engine::pipeline::blend::StoredTile;
use engine::pipeline::manifest::{CameraRecord, JobTasks, Recipe, ScaleRecord, VERSION};
use engine::pipeline::movie::{DisplayWindow, MovieTask};
use engine::pipeline::networks::ModelFile;
use engine::pipeline::pilot::full_schedule;
use engine::pipeline::records::{PilotRecord, PreparedRecord, WhiteRecord};
use engine::pipeline::tile::TileInput;
use formats::planar;
use reconstruction::registration::Correction;
use store::{
    Claimant, ClaimedTask, Completion, Heartbeat, JobTask, Lease, MovieWork, Product, StagedBlob,
    Store, StoreError, TileResult, Watcher, Work, WorkerPlace,
};

/// The store, and the worker that claims from it.
#[derive(Debug, Clone)]
pub struct Local {
    store: Store,
    worker: WorkerId,
    claimant: Claimant<'static>,
    /// Device of its networks, for the list of workers.
    device: String,
    /// Opened at the first use.
    watcher: Arc<Mutex<Option<Watcher>>>,
}

impl Local {
    /// A transport for the worker `worker` with networks on `device`, which takes the tasks that `claimant` may claim.
    pub fn new(
        store: Store,
        worker: WorkerId,
        claimant: Claimant<'static>,
        device: String,
    ) -> Self {
        Self { store, worker, claimant, device, watcher: Arc::default() }
    }

    fn arrays(&self, masks: Sha256, snapshots: Sha256, correction: Option<Correction>) -> Arrays {
        let [masks, snapshots] = [masks, snapshots].map(|sha256| (self.path(sha256), sha256));
        Arrays { masks, snapshots, correction }
    }

    /// Collects everything that a task needs.
    fn input(&self, work: Work, kind: TaskKind, lease: Lease) -> Result<TaskInput, TaskError> {
        match work {
            Work::Job(task) => self.step(&task, kind, lease.attempt),
            Work::Check(task) => Ok(TaskInput::Check(Box::new(Check {
                task: *task,
                store: self.store.clone(),
                lease,
                runtime: Handle::current(),
            }))),
            Work::Calibration(task) => match &task.captures {
                Some(captures) => Ok(TaskInput::Captures {
                    files: captures.map(|upload| self.path(*upload)),
                    bad_pixels: task.bad_pixels.map(|map| self.path(map)),
                    scratch: self.store.staged_path().map_err(failed)?,
                    masks: Box::new(self.store.blob_writer().map_err(failed)?),
                }),
                None => {
                    let masks = task.masks.ok_or_else(|| missing_input(kind))?;
                    Ok(TaskInput::Report { masks: self.path(masks), spectral: task.spectral })
                }
            },
            Work::Movie(work) => {
                let file = self.store.staged_path().map_err(failed)?;
                Ok(TaskInput::Movie(Box::new(movie_task(&work)?), file))
            }
        }
    }

    fn step(&self, task: &JobTask, kind: TaskKind, attempt: u32) -> Result<TaskInput, TaskError> {
        let JobTask { job, spec, calibration, measurement, .. } = task;
        let correction = correction(task.prepared.as_ref())?;
        let arrays = self.arrays(calibration.prepared, measurement.prepared, correction);
        let folder = || self.store.staged_dir().map_err(failed);
        Ok(match kind {
            TaskKind::Prepare => TaskInput::Prepare {
                // The calibrated masks are registered, also in a second attempt.
                arrays: Arrays { correction: None, ..arrays },
                snapshots: spec.snapshots,
                registration: spec.registration,
                is_coloured: spec.shape.mosaic.is_some() || spec.dispersion.is_some(),
            },
            TaskKind::Preview { snapshot } => TaskInput::Preview {
                arrays,
                shape: spec.shape,
                snapshot,
                white: white(task.prepared.as_ref())?,
            },
            TaskKind::Pilot => TaskInput::Pilot {
                arrays,
                snapshots: spec.snapshots,
                white: white(task.prepared.as_ref())?,
                schedule: spec.schedule.clone(),
                runs: spec.sequence_plan().map_err(PipelineError::from)?,
                mosaic: spec.shape.mosaic,
            },
            TaskKind::Tile { snapshot, tile, .. } => {
                TaskInput::Tile(Box::new(tile_task(task, snapshot, tile)?))
            }
            TaskKind::White => TaskInput::White {
                // As `reconstruct` does, which looks for dim pixels before it moves the masks.
                arrays: Arrays { correction: None, ..arrays },
                recipe: Box::new(recipe(task)?),
                snapshots: spec.snapshots,
                tiles: self.stored_tiles(&task.tiles)?,
            },
            TaskKind::Assemble { snapshot } => TaskInput::Assemble {
                job: *job,
                recipe: Box::new(recipe(task)?),
                snapshot,
                tiles: self.stored_tiles(&task.tiles)?,
                folder: folder()?,
            },
            TaskKind::Manifest => TaskInput::Manifest {
                job: *job,
                spec: Box::new(spec.clone()),
                recipe: Box::new(recipe(task)?),
                tasks: tasks(task, attempt)?,
                folder: folder()?,
            },
            TaskKind::Check
            | TaskKind::Calibration
            | TaskKind::Movie { .. }
            | TaskKind::Gif { .. } => {
                return Err(missing_input(kind).into());
            }
        })
    }

    /// Converts an output into a product of the store. Blocks on the disk.
    fn product(&self, output: Output) -> Result<Product, TransportError> {
        Ok(match output {
            Output::Record => Product::Record,
            Output::TileCost(share) => Product::TileCost(share),
            Output::Stack(frames) => Product::File(self.staged(frames.view())?),
            Output::File(file) => Product::File(file.finish()?),
            Output::Files(folder, files) => Product::Files(folder, files),
            Output::Checked(checked) => Product::Checked(checked),
            Output::Calibration(done) => Product::Calibration(done),
        })
    }

    /// Writes frames \[B,h,w\] as a prepared array.
    fn staged(&self, frames: ArrayView3<'_, f32>) -> Result<StagedBlob, TransportError> {
        let (count, height, width) = frames.dim();
        let mut writer = planar::writer(self.store.blob_writer()?, count, height, width)?;
        frames.outer_iter().try_for_each(|frame| writer.write_frame(frame))?;
        Ok(writer.finish()?.finish()?)
    }

    fn stored_tiles(&self, tiles: &[TileResult]) -> Result<Vec<StoredTile>, PipelineError> {
        tiles.iter().map(|tile| self.stored_tile(tile)).collect()
    }

    fn stored_tile(&self, stored: &TileResult) -> Result<StoredTile, PipelineError> {
        let TileResult { run, tile, sha256, record } = stored;
        let record = parsed("tile", record)?;
        Ok(StoredTile { run: *run, tile: *tile, path: self.path(*sha256), sha256: *sha256, record })
    }

    fn path(&self, sha256: Sha256) -> std::path::PathBuf {
        self.store.dir().blob(&sha256)
    }
}

impl Transport for Local {
    async fn started(&self) -> Result<(), TransportError> {
        let location = WorkerPlace { device: Some(self.device.clone()), ..WorkerPlace::default() };
        let (worker, pid) = (self.worker, std::process::id());
        Ok(self.store.worker_started(worker, pid, &location, self.claimant).await?)
    }

    async fn report_alive(&self) -> Result<(), TransportError> {
        Ok(self.store.worker_seen(self.worker).await?)
    }

    async fn idle(&self, time: Duration) {
        let mut slot = self.watcher.lock().await;
        let changed = async {
            let watcher = match &mut *slot {
                Some(watcher) => watcher,
                none => none.insert(self.store.watcher()?),
            };
            watcher.changed(time).await
        };
        if let Err(error) = changed.await {
            tracing::warn!(%error, "changes of the database can't be watched");
            *slot = None;
            tokio::time::sleep(time).await;
        }
    }

    async fn claim(&self) -> Result<Option<Claim>, TransportError> {
        let task = self.store.claim_as(self.claimant, self.worker, LEASE).await?;
        let Some(task) = task else { return Ok(None) };
        let ClaimedTask { lease, kind, cost, work } = task;
        let (id, name) = (lease.task, kind.into_str());
        let span = match &work {
            Work::Job(task) => {
                tracing::info_span!("task", job = %task.job, kind = name, task = %id)
            }
            Work::Check(task) => {
                tracing::info_span!("task", request = %task.request.id, kind = name, task = %id)
            }
            Work::Calibration(task) => {
                tracing::info_span!("task", calibration = %task.calibration, kind = name, task = %id)
            }
            Work::Movie(work) => {
                tracing::info_span!("task", job = %work.job, kind = name, task = %id)
            }
        };
        let transport = self.clone();
        let input = move || transport.input(work, kind, lease);
        let input = tokio::task::spawn_blocking(input).await?;
        Ok(Some(Claim { lease, span, cost, input }))
    }

    async fn busy_workers(&self) -> Result<Option<usize>, TransportError> {
        Ok(Some(self.store.busy_workers(LEASE).await?))
    }

    async fn heartbeat(
        &self,
        lease: &Lease,
        progress: TaskProgress,
        history: Option<&str>,
    ) -> Result<Heartbeat, TransportError> {
        Ok(self.store.heartbeat(lease, progress, history).await?)
    }

    async fn complete(&self, lease: &Lease, done: Done) -> Result<Heartbeat, TransportError> {
        let Done { progress, record, output } = done;
        let transport = self.clone();
        let product = tokio::task::spawn_blocking(move || transport.product(output)).await??;
        Ok(self.store.complete(lease, Completion { progress, record, product }).await?)
    }

    async fn fail(&self, lease: &Lease, reason: &str, retry: bool) -> Result<(), TransportError> {
        Ok(self.store.fail(lease, reason, retry).await?)
    }

    async fn postpone(&self, lease: &Lease, reason: &str) -> Result<(), TransportError> {
        Ok(self.store.postpone(lease, reason).await?)
    }

    async fn give_back(&self, lease: &Lease) -> Result<(), TransportError> {
        Ok(self.store.give_back(lease).await?)
    }

    async fn redo(&self, lease: &Lease, tiles: &[(u32, u32)]) -> Result<(), TransportError> {
        Ok(self.store.redo_tiles(lease, tiles).await?)
    }

    fn window(&self, task: &TileTask) -> Result<TileInput, PipelineError> {
        let arrays = self.arrays(task.masks, task.measurement, task.correction);
        let input = arrays.window(task.snapshots.clone(), &task.tile.window(), task.white)?;
        Ok(TileInput { pieces: task.pieces.clone(), ..input })
    }

    fn model(&self, sha256: Sha256) -> ModelFile {
        ModelFile::new(self.path(sha256), sha256)
    }
}

fn failed(error: StoreError) -> TaskError {
    TaskError::Transport(error.into())
}

fn missing_input(kind: TaskKind) -> PipelineError {
    let problem = format!("the {} task has no input", kind.into_str());
    PipelineError::Record { what: "task", problem }
}

/// Reads a record that this program wrote.
fn parsed<T: DeserializeOwned>(what: &'static str, record: &Value) -> Result<T, PipelineError> {
    T::deserialize(record).map_err(PipelineError::record(what))
}

/// The registration of the masks, as the prepare task recorded it. It is `None` before that task.
fn registered(prepared: Option<&Value>) -> Result<Option<Registered>, PipelineError> {
    let Some(prepared) = prepared else { return Ok(None) };
    Ok(parsed::<Option<PreparedRecord>>("prepare task", prepared)?.and_then(|it| it.registration))
}

/// The correction of the masks, if they have moved.
fn correction(prepared: Option<&Value>) -> Result<Option<Correction>, PipelineError> {
    Ok(registered(prepared)?.and_then(|registered| registered.correction()))
}

/// The solver's scale, as the prepare task recorded it.
fn white(prepared: Option<&Value>) -> Result<f32, PipelineError> {
    Ok(parsed::<PreparedRecord>("prepare task", prepared.unwrap_or(&Value::Null))?.white)
}

/// The white level of the frames, as its task recorded it.
fn white_level(record: &Value) -> Result<f32, PipelineError> {
    Ok(parsed::<WhiteRecord>("white level", record)?.white_level)
}

fn movie_task(work: &MovieWork) -> Result<MovieTask, PipelineError> {
    let MovieWork { spec, format, measurement, white, window, clips, .. } = work;
    let window = match window {
        Some(window) => parsed("movie", window)?,
        None => DisplayWindow {
            black: 0.0,
            white: white_level(white.as_ref().unwrap_or(&Value::Null))?,
        },
    };
    let facts = &measurement.facts;
    let frames = spec.shape.frames;
    let record = CameraRecord::new((facts.camera_fps, facts.exposure_s), 0, frames);
    // The bands of a spectral camera are exposed at the same time.
    let record = record.filter(|_| spec.dispersion.is_none());
    let exposure = record.and_then(|record| record.frame_exposure_s(frames));
    Ok(MovieTask {
        format: *format,
        shape: spec.frame_shape(),
        window,
        requested: work.window.is_some(),
        scene_fps: exposure.map(|seconds| 1.0 / seconds),
        clips: clips.clone(),
    })
}

/// The pilot's record. It is `None` before the pilot has run, and for a job without a pilot.
fn pilot(task: &JobTask) -> Result<Option<PilotRecord>, PipelineError> {
    parsed("pilot", task.pilot.as_ref().unwrap_or(&Value::Null))
}

/// Tile `index` of the run that begins with snapshot `first`. It follows from the job's plans and the records of
/// its earlier tasks.
pub fn tile_task(task: &JobTask, first: u32, index: u32) -> Result<TileTask, PipelineError> {
    let plan = task.spec.tile_plan()?;
    let tile = plan.tile(index as usize).ok_or_else(|| PipelineError::Record {
        what: "task",
        problem: format!("tile {index} of a plan of {}", plan.len()),
    })?;
    let pilot = pilot(task)?;
    let runs = task.spec.sequence_plan()?;
    let begins_here = |run: &Range<usize>| run.start == first as usize;
    let run = runs.runs().iter().position(begins_here).ok_or_else(|| PipelineError::Record {
        what: "task",
        problem: format!("no run begins with snapshot {first}"),
    })?;
    let start = runs.runs()[run].start;
    let pieces = runs.pieces(&pilot.as_ref().map(PilotRecord::cuts).unwrap_or_default());
    let run_pieces =
        pieces.into_iter().filter(|piece| piece.run == run).map(|piece| piece.snapshots);
    Ok(TileTask {
        masks: task.calibration.prepared,
        correction: correction(task.prepared.as_ref())?,
        measurement: task.measurement.prepared,
        snapshots: first..first + runs.runs()[run].len() as u32,
        pieces: run_pieces.map(|piece| piece.start - start..piece.end - start).collect(),
        tile,
        white: white(task.prepared.as_ref())?,
        schedule: full_schedule(&task.spec.schedule, pilot.as_ref()),
        evidence: pilot.as_ref().and_then(|pilot| pilot.evidence.clone()),
        model: task.spec.model.as_ref().map(|model| model.sha256),
        networks: task.spec.networks.clone(),
    })
}

fn recipe(task: &JobTask) -> Result<Recipe, PipelineError> {
    let (spec, calibration, measurement) =
        (&task.spec, &task.calibration.facts, &task.measurement.facts);
    let pilot = pilot(task)?;
    let normalisation = white(task.prepared.as_ref())?;
    Ok(Recipe {
        program_version: VERSION,
        algorithm: spec.algorithm,
        schedule: full_schedule(&spec.schedule, pilot.as_ref()),
        pilot,
        registration: registered(task.prepared.as_ref())?,
        shape: spec.shape,
        dispersion: spec.dispersion.clone(),
        inputs: Inputs { masks: task.calibration.inputs(), measurement: task.measurement.inputs() },
        models: ModelRecord::for_job(spec),
        scale: ScaleRecord {
            masks_full_scale: calibration.full_scale,
            measurement_full_scale: measurement.full_scale,
            normalisation,
            // Before it is determined, nothing is displayed or judged by it.
            white_level: task.white.as_ref().map_or(Ok(normalisation), white_level)?,
        },
        tile_plan: spec.tile_plan()?,
        runs: spec.sequence_plan()?,
        warnings: spec.warnings.clone(),
        camera: (measurement.camera_fps, measurement.exposure_s),
    })
}

/// Collects the records of a job's other tasks for its manifest. `attempt` is the number of the manifest task's
/// attempt.
fn tasks(task: &JobTask, attempt: u32) -> Result<JobTasks, PipelineError> {
    let mut tasks =
        JobTasks { snapshots: Vec::new(), seconds: Vec::new(), attempts: u64::from(attempt) };
    for task in &task.records {
        tasks.seconds.push((task.kind, task.seconds));
        tasks.attempts += u64::from(task.attempt);
        if let TaskKind::Assemble { snapshot } = task.kind {
            tasks.snapshots.push((snapshot, parsed("snapshot", &task.record)?));
        }
    }
    Ok(tasks)
}
