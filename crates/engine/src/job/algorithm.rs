//! The algorithms, and what belongs to each.

use serde::{Deserialize, Serialize};
use strum::{IntoStaticStr, VariantArray};

use super::shape::TileSpec;
use reconstruction::priors::registry::PriorName;
use reconstruction::schedule::Schedule;

#[derive(
    Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, IntoStaticStr, VariantArray,
)]
#[serde(rename_all = "kebab-case")]
#[strum(serialize_all = "kebab-case", const_into_str)]
pub enum Algorithm {
    GapTv,
    /// GAP with total variation in space and, where it pays, in time.
    GapTv3d,
    AdmmTv,
    PnpNonlocal,
    PnpFfdnet,
    PnpFastdvdnet,
    PnpTvFastdvdnet,
    /// A network from measurement and masks to frames, trained for one calibration.
    Learned,
}

impl Algorithm {
    /// What it does, in a sentence.
    pub fn summary(self) -> &'static str {
        match self {
            Self::GapTv => {
                "Accelerated generalized alternating projection with total variation: seconds, \
                 no network."
            }
            Self::GapTv3d => {
                "As gap-tv, with total variation along time, too, where a pilot finds that it pays: \
                 the best that takes seconds."
            }
            Self::AdmmTv => {
                "The alternating direction method of multipliers with total variation: for noisy \
                 measurements."
            }
            Self::PnpNonlocal => {
                "Total variation, then groups of similar patches of several frames, filtered by \
                 their own covariance: no network."
            }
            Self::PnpFfdnet => "Total variation, then FFDNet on each frame.",
            Self::PnpFastdvdnet => "Total variation, then FastDVDNet over the clip.",
            Self::PnpTvFastdvdnet => {
                "Total variation, a few passes of FastDVDNet, then the nonlocal prior: the best \
                 on all masks measured."
            }
            Self::Learned => {
                "A network of your own from measurement and masks to frames, registered for a \
                 calibration as a model: one run, no schedule."
            }
        }
    }

    /// The schedule of a job that names none; without stages for [`Self::Learned`], which has none.
    pub fn default_schedule(self) -> Schedule {
        match self {
            Self::GapTv => Schedule::gap_tv(),
            Self::GapTv3d => Schedule::gap_tv3d(),
            Self::AdmmTv => Schedule::admm_tv(),
            Self::PnpNonlocal => Schedule::pnp_nonlocal(),
            Self::PnpFfdnet => Schedule::pnp_ffdnet(),
            Self::PnpFastdvdnet => Schedule::pnp_fastdvdnet(),
            Self::PnpTvFastdvdnet => Schedule::pnp_tv_fastdvdnet(),
            Self::Learned => Schedule::none(),
        }
    }

    /// The tiles of a job that names none. Larger ones share less with their neighbours and are as fast
    /// (measured up to 512), but take more memory and let fewer workers help.
    pub fn default_tile(self) -> TileSpec {
        match self {
            Self::GapTv | Self::GapTv3d | Self::AdmmTv => TileSpec { size: 384, overlap: 16 },
            Self::Learned => TileSpec { size: 256, overlap: 32 },
            _ => TileSpec { size: 320, overlap: 32 },
        }
    }

    /// The priors that a schedule of this algorithm may name.
    pub fn priors(self) -> &'static [PriorName] {
        use PriorName::{Fastdvdnet, FastdvdnetInt8, Ffdnet, Nonlocal, Tv, TvFastdvdnet};
        match self {
            Self::GapTv | Self::GapTv3d | Self::AdmmTv => &[Tv],
            Self::PnpNonlocal => &[Tv, Nonlocal],
            Self::PnpFfdnet => &[Tv, Ffdnet],
            Self::PnpFastdvdnet => &[Tv, FastdvdnetInt8, Fastdvdnet],
            Self::PnpTvFastdvdnet => &[Tv, FastdvdnetInt8, Fastdvdnet, TvFastdvdnet, Nonlocal],
            Self::Learned => &[],
        }
    }

    /// What of a schedule does not belong to this algorithm, if anything: a name must not promise
    /// what the stages don't do.
    pub fn misfit(self, schedule: &Schedule) -> Option<String> {
        let own = self.priors();
        let stranger = schedule.stages.iter().find(|stage| !own.contains(&stage.prior.name()))?;
        let taken = |other: &&Self| other.misfit(schedule).is_none();
        // Later ones take more.
        let later = Self::VARIANTS.iter().skip_while(|other| **other != self).skip(1).find(taken);
        let instead =
            later.map_or_else(String::new, |other| format!("; ask for {}", other.into_str()));
        Some(format!("{} has no stages of {}{instead}", self.into_str(), stranger.prior.name()))
    }
}
