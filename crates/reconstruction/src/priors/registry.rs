//! All priors, with their names in JSON.

use std::ops::Deref;

use schemars::JsonSchema;
use serde::Serialize;
use strum::{Display, EnumString, IntoStaticStr, VariantNames};

use super::Spec;
use super::network::{FastdvdnetInt8Spec, FastdvdnetSpec, FfdnetSpec};
use super::nonlocal::NonlocalSpec;
use super::tv::TvSpec;
use super::tv_fastdvdnet::TvFastdvdnetSpec;
use crate::fields::{self, Fields};

/// Declares [`PriorSpec`] and [`PriorName`] from a table of names and parameters.
macro_rules! priors {
    ($($(#[$doc:meta])+ $name:literal => $variant:ident($spec:ty),)+) => {
        /// A prior and its parameters, as a stage of a schedule states them.
        #[derive(Debug, Clone, PartialEq, Serialize, JsonSchema)]
        #[serde(tag = "prior")]
        pub enum PriorSpec {
            $($(#[$doc])+ #[serde(rename = $name)] $variant($spec),)+
        }

        /// The name of a prior.
        #[derive(Debug, Clone, Copy, PartialEq, Eq)]
        #[derive(Display, EnumString, IntoStaticStr, VariantNames)]
        pub enum PriorName {
            $($(#[$doc])+ #[strum(serialize = $name)] $variant,)+
        }

        impl PriorSpec {
            /// The name of the prior.
            pub const fn name(&self) -> PriorName {
                match self {
                    $(Self::$variant(_) => PriorName::$variant,)+
                }
            }

            /// Reads the parameters of a prior from the fields of a stage.
            ///
            /// # Errors
            /// A message that names the field.
            pub(crate) fn read(name: PriorName, fields: &Fields) -> Result<Self, String> {
                match name {
                    $(PriorName::$variant => fields::read(fields).map(Self::$variant),)+
                }
            }

            fn spec_mut(&mut self) -> &mut dyn Spec {
                match self {
                    $(Self::$variant(spec) => spec,)+
                }
            }
        }

        impl Deref for PriorSpec {
            type Target = dyn Spec;

            fn deref(&self) -> &(dyn Spec + 'static) {
                match self {
                    $(Self::$variant(spec) => spec,)+
                }
            }
        }
    };
}

priors! {
    /// Isotropic total variation of each frame.
    "tv" => Tv(TvSpec),
    /// Groups of similar patches, each filtered by its covariance.
    "nonlocal" => Nonlocal(NonlocalSpec),
    /// FFDNet, frame by frame.
    "ffdnet" => Ffdnet(FfdnetSpec),
    /// FastDVDNet over the clip.
    "fastdvdnet" => Fastdvdnet(FastdvdnetSpec),
    /// FastDVDNet with weights and activations of 8 bits: a third of the time on a CPU, for noise levels of 8/255 and
    /// more. On a GPU it is computed in floating point, and the manifest names that network.
    "fastdvdnet-int8" => FastdvdnetInt8(FastdvdnetInt8Spec),
    /// Total variation, then FastDVDNet, in each iteration.
    "tv+fastdvdnet" => TvFastdvdnet(TvFastdvdnetSpec),
}

impl PriorSpec {
    /// Sets the noise level of the first and the last iteration; no effect for a prior without one.
    pub(crate) fn set_sigma(&mut self, sigma: [f32; 2]) {
        self.spec_mut().set_sigma(sigma);
    }

    /// The parameters of total variation, if it is a part of the prior.
    pub fn tv(&self) -> Option<&TvSpec> {
        match self {
            Self::Tv(tv) | Self::TvFastdvdnet(TvFastdvdnetSpec { tv, .. }) => Some(tv),
            _ => None,
        }
    }

    /// Mutable access to [`PriorSpec::tv`].
    pub fn tv_mut(&mut self) -> Option<&mut TvSpec> {
        match self {
            Self::Tv(tv) | Self::TvFastdvdnet(TvFastdvdnetSpec { tv, .. }) => Some(tv),
            _ => None,
        }
    }

    /// The parameters of the nonlocal prior.
    pub fn nonlocal(&self) -> Option<&NonlocalSpec> {
        if let Self::Nonlocal(nonlocal) = self { Some(nonlocal) } else { None }
    }

    /// Mutable access to [`PriorSpec::nonlocal`].
    pub fn nonlocal_mut(&mut self) -> Option<&mut NonlocalSpec> {
        if let Self::Nonlocal(nonlocal) = self { Some(nonlocal) } else { None }
    }
}

impl PriorName {
    /// The prior with this name.
    ///
    /// # Errors
    /// A message that lists the names.
    pub(crate) fn parse(name: &str) -> Result<Self, String> {
        name.parse().map_err(|_| {
            let names = Self::VARIANTS.join("`, `");
            format!("unknown variant `{name}`, expected one of `{names}`")
        })
    }
}
