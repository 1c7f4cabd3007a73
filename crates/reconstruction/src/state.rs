//! The variables of a reconstruction, in the memory of the host or of a GPU.

use std::borrow::Cow;

use ndarray::Array3;

use super::error::Result;
#[cfg(feature = "gpu")]
use super::gpu::frames::DeviceFrames;
use super::hold_out::HoldOut;
use super::iterate::{Iterate, Variables};
use super::priors::Networks;
use super::projection::{Problem, Settings};
#[cfg(feature = "gpu")]
use super::resident::{Copies, Resident};
use super::stage::Stage;

/// The variables that one iteration hands to the next. They stay where they are from the first stage to the last.
pub(crate) enum State {
    Host(Box<Iterate>),
    #[cfg(feature = "gpu")]
    Gpu(Box<Resident>),
}

/// A copy of the variables, in the same memory.
pub(crate) enum Snapshot {
    Host(Iterate),
    #[cfg(feature = "gpu")]
    Gpu(Copies),
}

/// Frames \[S B,H,W\] in the memory of the host or of a GPU.
pub(crate) enum Frames {
    Host(Array3<f32>),
    #[cfg(feature = "gpu")]
    Gpu(DeviceFrames),
}

impl State {
    /// All variables, 0 at first, on the GPU if there is one.
    ///
    /// # Errors
    /// The GPU is too small or lost.
    #[cfg_attr(not(feature = "gpu"), allow(unused_variables))]
    pub(crate) fn new(
        problem: Problem<'_>,
        variables: Variables,
        networks: &mut dyn Networks,
    ) -> Result<Self> {
        #[cfg(feature = "gpu")]
        if let Some(gpu) = networks.gpu()? {
            return Ok(Self::Gpu(Box::new(Resident::new(gpu, problem, variables)?)));
        }
        Ok(Self::Host(Box::new(Iterate::zeros(problem.operator, variables))))
    }

    /// Prepares the iterations of a stage.
    ///
    /// # Errors
    /// The GPU is too small or lost.
    #[cfg_attr(not(feature = "gpu"), allow(unused_variables))]
    pub(crate) fn start(
        &mut self,
        problem: Problem<'_>,
        settings: &Settings,
        stage: &Stage,
    ) -> Result<()> {
        #[cfg(feature = "gpu")]
        if let Self::Gpu(resident) = self {
            resident.start(problem, settings, stage)?;
        }
        Ok(())
    }

    /// The frames `v` \[S B,H,W\], copied to the host if they are on a GPU.
    ///
    /// # Errors
    /// The GPU is lost.
    pub(crate) fn frames(&self) -> Result<Cow<'_, Array3<f32>>> {
        match self {
            Self::Host(iterate) => Ok(Cow::Borrowed(&iterate.v)),
            #[cfg(feature = "gpu")]
            Self::Gpu(resident) => Ok(Cow::Owned(resident.frames().read()?)),
        }
    }

    /// A copy of the frames `v` in the same memory.
    ///
    /// # Errors
    /// The GPU is too small or lost.
    pub(crate) fn keep_frames(&self) -> Result<Frames> {
        match self {
            Self::Host(iterate) => Ok(Frames::Host(iterate.v.clone())),
            #[cfg(feature = "gpu")]
            Self::Gpu(resident) => Ok(Frames::Gpu(resident.frames().copied()?)),
        }
    }

    /// The frames `v` on the host. The other variables are lost.
    ///
    /// # Errors
    /// The GPU is lost.
    pub(crate) fn into_frames(self) -> Result<Array3<f32>> {
        match self {
            Self::Host(iterate) => Ok(iterate.v),
            #[cfg(feature = "gpu")]
            Self::Gpu(resident) => resident.frames().read(),
        }
    }

    /// Changes the frames `v` on the host.
    ///
    /// # Errors
    /// The GPU is lost.
    pub(crate) fn edit_frames(&mut self, edit: impl FnOnce(&mut Array3<f32>)) -> Result<()> {
        match self {
            Self::Host(iterate) => edit(&mut iterate.v),
            #[cfg(feature = "gpu")]
            Self::Gpu(resident) => {
                let mut frames = resident.frames().read()?;
                edit(&mut frames);
                resident.frames().write(&frames);
            }
        }
        Ok(())
    }

    /// A copy of the variables, for [`State::restore`].
    ///
    /// # Errors
    /// The GPU is too small or lost.
    pub(crate) fn snapshot(&self) -> Result<Snapshot> {
        match self {
            Self::Host(iterate) => Ok(Snapshot::Host(iterate.snapshot())),
            #[cfg(feature = "gpu")]
            Self::Gpu(resident) => Ok(Snapshot::Gpu(resident.snapshot()?)),
        }
    }

    /// Goes back to a snapshot, and returns the frames `v` that it replaces.
    pub(crate) fn restore(&mut self, snapshot: Snapshot) -> Frames {
        match (self, snapshot) {
            (Self::Host(iterate), Snapshot::Host(snapshot)) => {
                Frames::Host(iterate.restore(snapshot))
            }
            #[cfg(feature = "gpu")]
            (Self::Gpu(resident), Snapshot::Gpu(copies)) => Frames::Gpu(resident.restore(copies)),
            #[cfg(feature = "gpu")]
            _ => unreachable!("a snapshot stays in the memory of its variables"),
        }
    }

    /// `(y - H v)^2` of each hold-out pixel.
    ///
    /// # Errors
    /// The GPU is too small or lost.
    pub(crate) fn hold_out_residuals(
        &self,
        Problem { operator, y }: Problem<'_>,
        hold_out: &HoldOut,
    ) -> Result<Vec<f64>> {
        match self {
            Self::Host(iterate) => Ok(hold_out.residuals(operator, y.view(), iterate.v.view())),
            #[cfg(feature = "gpu")]
            Self::Gpu(resident) => resident.hold_out_residuals(&hold_out.pixels),
        }
    }
}

impl Snapshot {
    /// Another copy.
    ///
    /// # Errors
    /// The GPU is too small or lost.
    pub(crate) fn copied(&self) -> Result<Self> {
        match self {
            Self::Host(iterate) => Ok(Self::Host(iterate.snapshot())),
            #[cfg(feature = "gpu")]
            Self::Gpu(copies) => Ok(Self::Gpu(copies.copied()?)),
        }
    }

    /// The frames `v`, copied to the host if they are on a GPU.
    ///
    /// # Errors
    /// The GPU is lost.
    pub(crate) fn frames(&self) -> Result<Cow<'_, Array3<f32>>> {
        match self {
            Self::Host(iterate) => Ok(Cow::Borrowed(&iterate.v)),
            #[cfg(feature = "gpu")]
            Self::Gpu(copies) => Ok(Cow::Owned(copies.v.read()?)),
        }
    }
}

impl Frames {
    /// The frames on the host.
    ///
    /// # Errors
    /// The GPU is lost.
    pub(crate) fn into_host(self) -> Result<Array3<f32>> {
        match self {
            Self::Host(frames) => Ok(frames),
            #[cfg(feature = "gpu")]
            Self::Gpu(frames) => frames.read(),
        }
    }
}
