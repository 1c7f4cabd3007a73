//! Total variation and FastDVDNet in series: the second period of Algorithm 1 of the paper.

use ndarray::Array3;
use schemars::JsonSchema;
use serde::{Deserialize, Deserializer, Serialize, de::Error};

use super::network::FastdvdnetSpec;
use super::tv::{TvPrior, TvSpec};
use super::{Family, Network, Networks, Prior, Size, Spec, WorkingSet};
use crate::error::Result;
use crate::fields::{self, Fields};

/// Parameters of total variation, then FastDVDNet, in each iteration.
#[derive(Debug, Clone, PartialEq, Serialize, JsonSchema)]
pub struct TvFastdvdnetSpec {
    /// Total variation, which comes first.
    #[serde(flatten)]
    pub tv: TvSpec,
    /// FastDVDNet.
    #[serde(flatten)]
    pub network: FastdvdnetSpec,
}

impl<'de> Deserialize<'de> for TvFastdvdnetSpec {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let fields = Fields::deserialize(deserializer)?;
        let tv = fields::read(&fields).map_err(D::Error::custom)?;
        let network = fields::read(&fields).map_err(D::Error::custom)?;
        Ok(Self { tv, network })
    }
}

impl Spec for TvFastdvdnetSpec {
    fn family(&self) -> Family {
        self.network.family()
    }

    fn network(&self) -> Option<Network> {
        self.network.network()
    }

    fn has_total_variation(&self) -> bool {
        self.tv.has_total_variation()
    }

    fn sigma(&self) -> Option<[f32; 2]> {
        self.network.sigma()
    }

    fn set_sigma(&mut self, sigma: [f32; 2]) {
        self.network.set_sigma(sigma);
    }

    fn iteration_ns(&self) -> f64 {
        self.tv.iteration_ns() + self.network.iteration_ns()
    }

    fn working_set(&self) -> WorkingSet {
        self.network.working_set()
    }

    fn start<'n>(&self, size: Size, networks: &'n mut dyn Networks) -> Result<Box<dyn Prior + 'n>> {
        let (first, second) = (TvPrior::new(&self.tv, size), self.network.start(size, networks)?);
        Ok(Box::new(Series { first, second }))
    }
}

struct Series<'n> {
    first: TvPrior,
    second: Box<dyn Prior + 'n>,
}

impl Prior for Series<'_> {
    fn denoise(&mut self, frames: &mut Array3<f32>, sigma: f32) -> Result<()> {
        self.first.denoise(frames, sigma)?;
        self.second.denoise(frames, sigma)
    }
}
