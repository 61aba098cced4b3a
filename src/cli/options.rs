//! Options that `extract` and `compare` share: how a surface is wrapped.

use crate::extract::Budget;
use crate::shrink::lattice::LatticeSpec;
use crate::shrink::{Component, Density, Distortion, Method, OnTopology, ShrinkSpec};
use clap::{Args, ValueEnum};

/// How a surface is wrapped.
#[derive(Debug, Args)]
pub struct ShrinkArgs {
    /// How the sphere is contracted
    #[arg(long, value_enum, default_value_t = MethodArg::Adaptive)]
    pub method: MethodArg,
    /// How the samples are spread over the surface
    #[arg(long, value_enum, default_value_t = DensityArg::Curvature)]
    pub density: DensityArg,
    /// What the sphere map keeps best
    #[arg(long, value_enum, default_value_t = DistortionArg::Isometric)]
    pub distortion: DistortionArg,
    /// Relax the UVs further inside the chart, by what --distortion keeps; the sphere's coordinates become TEXCOORD_1
    #[arg(long)]
    pub relax_uv: bool,
    /// What to do with a shape that has handles or several components
    #[arg(long, value_enum, default_value_t = OnTopologyArg::Refuse)]
    pub on_topology: OnTopologyArg,
    /// Component to wrap where there are several: largest, or an index from 0, largest first
    #[arg(long, value_name = "WHICH", value_parser = parse_component)]
    pub component: Option<Component>,
    /// Attempts at most, each with more effort, until one passes [default: 3]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=3))]
    pub attempts: Option<u32>,
    /// Field evaluations that a further attempt may not go beyond
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..))]
    pub max_evaluations: Option<u64>,
}

impl ShrinkArgs {
    /// What they ask for on a lattice.
    pub fn spec(&self, lattice: LatticeSpec) -> ShrinkSpec {
        ShrinkSpec {
            method: self.method.into(),
            lattice,
            density: self.density.into(),
            distortion: self.distortion.into(),
            relax_uv: self.relax_uv,
            on_topology: self.on_topology.into(),
            component: self.component,
            samples: None,
        }
    }

    /// What may be spent on it.
    pub fn budget(&self) -> Budget {
        Budget { attempts: self.attempts, evaluations: self.max_evaluations }
    }
}

/// How the sphere is contracted.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum MethodArg {
    /// Topology-keeping contraction and a bijective sphere map
    Adaptive,
    /// The paper's loop as printed
    Paper,
}

impl From<MethodArg> for Method {
    fn from(method: MethodArg) -> Self {
        match method {
            MethodArg::Adaptive => Method::Adaptive,
            MethodArg::Paper => Method::Paper,
        }
    }
}

/// How the samples are spread over the surface.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum DensityArg {
    /// Evenly by area
    Area,
    /// More where the surface is curved
    Curvature,
    /// More where the solid or the space beside it is thin
    Reach,
}

impl From<DensityArg> for Density {
    fn from(density: DensityArg) -> Self {
        match density {
            DensityArg::Area => Density::Area,
            DensityArg::Curvature => Density::Curvature,
            DensityArg::Reach => Density::Reach,
        }
    }
}

/// What the sphere map keeps best.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum DistortionArg {
    /// Areas, as far as the density allows
    Area,
    /// Angles
    Angle,
    /// Both: lengths
    Isometric,
}

impl From<DistortionArg> for Distortion {
    fn from(distortion: DistortionArg) -> Self {
        match distortion {
            DistortionArg::Area => Distortion::Area,
            DistortionArg::Angle => Distortion::Angle,
            DistortionArg::Isometric => Distortion::Isometric,
        }
    }
}

/// What to do with a shape that is no sphere.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum OnTopologyArg {
    /// Say how many components or handles there are and where
    Refuse,
    /// Wrap it all the same and say how much area had to be invented
    Wrap,
}

impl From<OnTopologyArg> for OnTopology {
    fn from(on_topology: OnTopologyArg) -> Self {
        match on_topology {
            OnTopologyArg::Refuse => OnTopology::Refuse,
            OnTopologyArg::Wrap => OnTopology::Wrap,
        }
    }
}

/// `largest` or an index.
fn parse_component(text: &str) -> Result<Component, String> {
    match text {
        "largest" => Ok(Component::Largest),
        index => index.parse().map(Component::Index).map_err(|_| "expected largest or an index from 0".to_owned()),
    }
}

/// `latlong:200x100` or `octahedral:72`.
pub fn parse_lattice(text: &str) -> Result<LatticeSpec, String> {
    let number = |n: &str| n.parse::<u32>().map_err(|_| format!("{n:?} is not a whole number"));
    let lattice = match text.split_once(':') {
        Some(("latlong", sizes)) => {
            let (n_theta, n_phi) = sizes.split_once('x').ok_or("expected latlong:N_THETAxN_PHI")?;
            LatticeSpec::Latlong { n_theta: number(n_theta)?, n_phi: number(n_phi)? }
        }
        Some(("octahedral", n)) => LatticeSpec::Octahedral { n: number(n)? },
        _ => return Err("expected latlong:N_THETAxN_PHI or octahedral:N".to_owned()),
    };
    let faults = crate::job::spec::check_lattice(lattice, "");
    match faults.first() {
        Some(fault) => Err(format!("{}: {}", fault.pointer.trim_start_matches('/'), fault.detail)),
        None => Ok(lattice),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_lattice_is_read_as_it_is_written_and_kept_within_limits() {
        assert_eq!(parse_lattice("latlong:200x100"), Ok(LatticeSpec::Latlong { n_theta: 200, n_phi: 100 }));
        assert_eq!(parse_lattice("octahedral:72"), Ok(LatticeSpec::Octahedral { n: 72 }));
        for wrong in ["latlong:200", "octahedral:x", "cube:3", "octahedral:501", "latlong:7x100", "octahedral:-1"] {
            assert!(parse_lattice(wrong).is_err(), "{wrong}");
        }
    }
}
