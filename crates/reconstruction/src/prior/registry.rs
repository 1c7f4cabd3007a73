//! All priors, and how they are named in JSON.

use std::borrow::Cow;
use std::fmt;
use std::ops::Range;
use std::sync::LazyLock;

use ndarray::Array3;
use schemars::{JsonSchema, Schema, SchemaGenerator, json_schema};
use serde::de::{Deserialize, Deserializer, Error};
use serde::{Serialize, Serializer};

use super::network::{FASTDVDNET, FASTDVDNET_INT8, FFDNET};
use super::nonlocal::NONLOCAL;
use super::tv::TV;
use super::{Memory, Network, Networks, Parameter, Pass, Prior, Ready, Settings};
use crate::error::Result;

/// Every prior that a schedule may name.
pub static PRIORS: [&dyn Prior; 6] =
    [&TV, &NONLOCAL, &FFDNET, &FASTDVDNET, &FASTDVDNET_INT8, &TV_FASTDVDNET];

/// Total variation, then the video denoiser: the second period of Algorithm 1 of the paper.
pub const TV_FASTDVDNET: Series = Series {
    name: "tv+fastdvdnet",
    summary: "total variation, then FastDVDNet, in each iteration",
    first: &TV,
    second: &FASTDVDNET,
};

/// Two priors in series.
pub struct Series {
    name: &'static str,
    summary: &'static str,
    first: &'static dyn Prior,
    second: &'static dyn Prior,
}

impl Prior for Series {
    fn name(&self) -> &'static str {
        self.name
    }

    fn summary(&self) -> &'static str {
        self.summary
    }

    fn parameters(&self) -> Vec<&'static Parameter> {
        [self.first.parameters(), self.second.parameters()].concat()
    }

    fn network(&self) -> Option<Network> {
        self.first.network().or(self.second.network())
    }

    fn cost(&self, settings: &Settings) -> f64 {
        self.first.cost(settings) + self.second.cost(settings)
    }

    fn looks_along_time(&self, settings: &Settings) -> bool {
        self.first.looks_along_time(settings) || self.second.looks_along_time(settings)
    }

    fn memory(&self) -> Memory {
        let (first, second) = (self.first.memory(), self.second.memory());
        Memory {
            per_voxel: first.per_voxel + second.per_voxel,
            per_network_pixel: first.per_network_pixel + second.per_network_pixel,
        }
    }

    fn begin(&self, size: (usize, usize, usize)) -> Box<dyn Pass> {
        Box::new((self.first.begin(size), self.second.begin(size)))
    }
}

impl Pass for (Box<dyn Pass>, Box<dyn Pass>) {
    fn apply(
        &mut self,
        x: &mut Array3<f32>,
        rows: Range<usize>,
        settings: &Settings,
        networks: &mut dyn Networks,
        ready: &mut Ready<'_>,
    ) -> Result<()> {
        self.0.apply(x, rows.clone(), settings, networks, &mut |_, _, _| ())?;
        self.1.apply(x, rows, settings, networks, ready)
    }
}

static NAMES: LazyLock<Vec<&'static str>> =
    LazyLock::new(|| PRIORS.iter().map(|prior| prior.name()).collect());

impl Serialize for dyn Prior {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_str(self.name())
    }
}

impl<'de> Deserialize<'de> for &'static dyn Prior {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let name = Cow::<str>::deserialize(deserializer)?;
        let found = PRIORS.into_iter().find(|prior| prior.name() == name);
        found.ok_or_else(|| D::Error::unknown_variant(&name, &NAMES))
    }
}

impl JsonSchema for dyn Prior {
    fn schema_name() -> Cow<'static, str> {
        "Prior".into()
    }

    fn json_schema(_: &mut SchemaGenerator) -> Schema {
        let one = |prior: &dyn Prior| {
            json_schema!({
                "type": "string", "const": prior.name(), "description": prior.summary(),
            })
        };
        json_schema!({ "oneOf": PRIORS.map(one) })
    }
}

impl PartialEq for dyn Prior {
    fn eq(&self, other: &Self) -> bool {
        self.name() == other.name()
    }
}

impl fmt::Debug for dyn Prior {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}
