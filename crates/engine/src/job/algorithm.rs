//! Reconstruction algorithms with their default schedules, tiles and priors.

use serde::{Deserialize, Serialize};
use strum::{EnumString, IntoStaticStr, VariantArray};

use super::shape::TileSpec;
use reconstruction::priors::registry::PriorName;
use reconstruction::schedule::Schedule;

/// A reconstruction algorithm.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[derive(Serialize, Deserialize, schemars::JsonSchema)]
#[derive(EnumString, IntoStaticStr, VariantArray, strum::VariantNames)]
#[serde(rename_all = "kebab-case")]
#[strum(serialize_all = "kebab-case", const_into_str)]
pub enum Algorithm {
    GapTv,
    /// GAP with total variation in space, and in time where the pilot finds a gain.
    GapTv3d,
    AdmmTv,
    PnpNonlocal,
    PnpFfdnet,
    PnpFastdvdnet,
    PnpTvFastdvdnet,
    /// An end-to-end network from measurement and masks to frames, trained for one calibration.
    Learned,
}

impl Algorithm {
    /// A one-sentence description for users.
    pub fn summary(self) -> &'static str {
        match self {
            Self::GapTv => {
                "Accelerated generalized alternating projection with total variation: takes seconds, \
                 needs no network."
            }
            Self::GapTv3d => {
                "Like gap-tv, with total variation along time where a pilot finds a gain: the best \
                 algorithm that takes seconds."
            }
            Self::AdmmTv => {
                "Alternating direction method of multipliers with total variation, for noisy measurements."
            }
            Self::PnpNonlocal => {
                "Total variation, then nonlocal filtering of similar patches from several frames: needs \
                 no network."
            }
            Self::PnpFfdnet => "Total variation, then FFDNet on each frame.",
            Self::PnpFastdvdnet => "Total variation, then FastDVDNet over the clip.",
            Self::PnpTvFastdvdnet => {
                "Total variation, a few passes of FastDVDNet, then the nonlocal prior: the best quality \
                 on all masks tested."
            }
            Self::Learned => {
                "Your own end-to-end network, registered as a model for one calibration: it runs once, \
                 without a schedule."
            }
        }
    }

    /// The schedule of a job that does not state one. It has no stages for [`Self::Learned`].
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

    /// The tiles of a job that does not state any. Larger tiles waste less on overlaps, but take more memory and spread
    /// over fewer workers; the speed per pixel is the same up to a size of 512.
    pub fn default_tile(self) -> TileSpec {
        match self {
            Self::GapTv | Self::GapTv3d | Self::AdmmTv => TileSpec { size: 384, overlap: 16 },
            Self::Learned => TileSpec { size: 256, overlap: 32 },
            _ => TileSpec { size: 320, overlap: 32 },
        }
    }

    /// The priors that a schedule of this algorithm may use.
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

    /// Explains why a schedule does not belong to this algorithm; `None` if it does. The name of an algorithm must
    /// match what its stages do.
    pub fn misfit(self, schedule: &Schedule) -> Option<String> {
        let priors = self.priors();
        let unsupported =
            schedule.stages.iter().find(|stage| !priors.contains(&stage.prior.name()))?;
        let accepts = |other: &&Self| other.misfit(schedule).is_none();
        // Algorithms are ordered by the priors they support, so a suitable one comes later.
        let alternative =
            Self::VARIANTS.iter().skip_while(|other| **other != self).skip(1).find(accepts);
        let hint = alternative
            .map_or_else(String::new, |other| format!("; use the algorithm {}", other.into_str()));
        Some(format!(
            "{} does not support the prior {}{hint}",
            self.into_str(),
            unsupported.prior.name()
        ))
    }
}
