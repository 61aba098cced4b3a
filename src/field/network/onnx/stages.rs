//! Activations of the graph, and how they become the layers of a network.
//!
//! A stage is an activation over a list of forms. Stages that are equally far from the input stand side by side in one layer, so
//! an exporter may compute a layer in pieces; a layer sees the layer before it and the network's input, nothing else. Sines and
//! cosines of the coordinates alone, at octaves of one frequency, are no layer but the encoding of the point.

use super::budget::Budget;
use super::forms::{Core, Forms, Unit};
use crate::field::FieldError;
use crate::field::network::{
    Activation, Encoding, Layer, MAX_FREQUENCIES, MAX_LAYERS, MAX_PARAMETERS, MAX_WIDTH, Network, Skip,
};
use std::f64::consts::FRAC_PI_2;
use std::rc::Rc;

/// Most activations of a graph: all layers, and a sine and a cosine for every octave of an encoding.
const MAX_STAGES: usize = 256;
/// How far, relative to it, a frequency may be from the octave that it stands for: some roundings of single precision.
const SAME_FREQUENCY: f64 = 1e-6;

/// How far a phase may be from that of the cosine: roundings of double precision, for a cosine is read as a shifted sine.
const SAME_PHASE: f64 = 1e-12;

/// For every stage that is part of the encoding the columns of the input that its units are, with their signs.
type Places = Vec<Option<Vec<(usize, f64)>>>;

/// An activation over forms.
#[derive(Debug)]
pub(super) struct Stage {
    pub activation: Activation,
    pub forms: Rc<Forms>,
    /// The node, for messages.
    title: String,
}

/// All stages so far, each after those that it takes.
#[derive(Debug)]
pub(super) struct Stages {
    inputs: usize,
    list: Vec<Stage>,
}

impl Stages {
    /// No stage yet; the network has so many inputs.
    pub(super) fn new(inputs: usize) -> Self {
        Self { inputs, list: Vec::new() }
    }

    /// Number of units of a stage; stage 0 is the input.
    pub(super) fn units(&self, stage: usize) -> usize {
        stage.checked_sub(1).map_or(self.inputs, |at| self.list[at].forms.len())
    }

    /// A stage but the input.
    pub(super) fn stage(&self, stage: usize) -> Option<&Stage> {
        self.list.get(stage.checked_sub(1)?)
    }

    /// Adds a stage and gives its outputs. A common factor of the arguments of a sine or a softplus becomes the parameter of
    /// the activation, so that `softplus(100 x) / 100` is found to be the softplus of sharpness 100.
    pub(super) fn activate(
        &mut self,
        forms: &Rc<Forms>,
        activation: Activation,
        title: String,
    ) -> Result<Forms, FieldError> {
        if self.list.len() == MAX_STAGES {
            let (found, limit) = (MAX_STAGES as u64 + 1, MAX_STAGES as u64);
            return Err(FieldError::Limit { what: "activations of an ONNX graph", found, limit });
        }
        if forms.len() > MAX_WIDTH {
            return Err(FieldError::Limit {
                what: "outputs of a layer",
                found: forms.len() as u64,
                limit: MAX_WIDTH as u64,
            });
        }
        let factor = forms.scale[0];
        let parameter = factor as f32;
        let common = forms.scale.iter().all(|&scale| scale == factor)
            && matches!(forms.core, Core::Rows(_))
            && f64::from(parameter) == factor;
        let (with_parameter, gain) = match activation {
            Activation::Sine { .. } => (Activation::Sine { w0: parameter }, 1.0),
            Activation::Softplus { .. } => (Activation::Softplus { beta: parameter }, factor),
            other => (other, 1.0),
        };
        let stage = self.list.len() + 1;
        let mut outputs = Forms::units(stage, 0..forms.len());
        if common && with_parameter != activation && with_parameter.is_valid() {
            let shift = forms.shift.iter().map(|shift| shift / factor).collect();
            let forms = Forms { scale: vec![1.0; forms.len()], shift, core: forms.core.clone() };
            self.list.push(Stage { activation: with_parameter, forms: Rc::new(forms), title });
            outputs.scale.fill(gain);
        } else {
            self.list.push(Stage { activation, forms: forms.clone(), title });
        }
        Ok(outputs)
    }

    /// The layers of the network whose value is the one form `output`.
    pub(super) fn network(
        mut self,
        output: &Rc<Forms>,
        latent_size: usize,
        budget: &mut Budget,
    ) -> Result<Network, FieldError> {
        let last = match &output.core {
            Core::Units(units)
                if output.scale[0] == 1.0 && output.shift[0] == 0.0 && self.units(units[0].stage) == 1 =>
            {
                units[0].stage
            }
            _ => 0,
        };
        if last == 0 {
            let title = "the output of the ONNX graph".to_owned();
            self.list.push(Stage { activation: Activation::Identity, forms: output.clone(), title });
        }
        let last = if last == 0 { self.list.len() } else { last };
        let parents: Vec<Vec<usize>> = self.list.iter().map(|stage| parents(&stage.forms)).collect();
        let needed = needed(&parents, last);
        let (encoding, places) = self.encoding(&parents, &needed, last, latent_size);
        let depths = self.depths(&parents, &needed, &places)?;
        let plan = Plan { stages: &self, parents, depths, places, input: latent_size + encoding.size() };
        Ok(Network { encoding, latent_size, ..Network::of_layers(plan.layers(budget)?) })
    }

    /// The encoding that the needed sines of coordinates make up, and for every stage that is part of it the columns of the
    /// input that its units are, with their signs. Either all such sines fit one encoding, or none is taken.
    fn encoding(&self, parents: &[Vec<usize>], needed: &[bool], last: usize, latent_size: usize) -> (Encoding, Places) {
        let waves: Vec<Option<Vec<Wave>>> =
            (0..self.list.len())
                .map(|i| {
                    if needed[i] && i + 1 != last && parents[i] == [0] {
                        waves(&self.list[i], latent_size)
                    } else {
                        None
                    }
                })
                .collect();
        let none = (Encoding::Identity, vec![None; self.list.len()]);
        let all = || waves.iter().flatten().flatten();
        let base = all().map(|wave| wave.frequency).fold(f64::INFINITY, f64::min);
        let octave = |wave: &Wave| {
            let octave = (wave.frequency / base).log2().round();
            let fits = (wave.frequency / (base * octave.exp2()) - 1.0).abs() <= SAME_FREQUENCY;
            (fits && octave < f64::from(MAX_FREQUENCIES)).then_some(octave as usize)
        };
        let Some(octaves) = all().map(octave).collect::<Option<Vec<usize>>>() else {
            return none;
        };
        let (Some(highest), true) = (octaves.into_iter().max(), base <= 1e4) else {
            return none;
        };
        let encoding = Encoding::Positional { frequencies: highest as u32 + 1, base };
        let place = |wave: &Wave| {
            let octave = octave(wave).unwrap_or(0);
            (latent_size + 3 + 6 * octave + if wave.cosine { 3 } else { 0 } + wave.axis, wave.sign)
        };
        (encoding, waves.iter().map(|stage| stage.as_ref().map(|list| list.iter().map(place).collect())).collect())
    }

    /// How many layers below its outputs every needed stage is; 0 for one that is not needed or part of the encoding.
    fn depths(
        &self,
        parents: &[Vec<usize>],
        needed: &[bool],
        places: &[Option<Vec<(usize, f64)>>],
    ) -> Result<Vec<usize>, FieldError> {
        let mut depths = vec![0; self.list.len()];
        for i in 0..self.list.len() {
            if !needed[i] || places[i].is_some() {
                continue;
            }
            let below = |&parent: &usize| if parent == 0 { 0 } else { depths[parent - 1] };
            let depth = parents[i].iter().map(below).max().unwrap_or(0) + 1;
            if let Some(parent) = parents[i].iter().find(|p| (1..depth - 1).contains(&below(p))) {
                let detail = format!(
                    "{} takes what {} gives past a layer in between (residual connections are not read)",
                    self.list[i].title,
                    self.list[parent - 1].title
                );
                return Err(FieldError::Unsupported { detail });
            }
            depths[i] = depth;
        }
        Ok(depths)
    }
}

/// The stages whose units the forms take, in order.
fn parents(forms: &Forms) -> Vec<usize> {
    let mut list: Vec<usize> = match &forms.core {
        Core::Units(units) => {
            units.iter().zip(&forms.scale).filter(|(_, s)| **s != 0.0).map(|(u, _)| u.stage).collect()
        }
        Core::Rows(blocks) => blocks.iter().map(|block| block.stage).collect(),
    };
    list.sort_unstable();
    list.dedup();
    list
}

/// Which stages the last one takes, over however many others.
fn needed(parents: &[Vec<usize>], last: usize) -> Vec<bool> {
    let mut needed = vec![false; parents.len()];
    needed[last - 1] = true;
    for i in (0..last).rev() {
        if needed[i] {
            parents[i].iter().filter(|&&p| p > 0).for_each(|&p| needed[p - 1] = true);
        }
    }
    needed
}

/// A sine or a cosine of one coordinate.
struct Wave {
    axis: usize,
    frequency: f64,
    cosine: bool,
    sign: f64,
}

/// The units of a stage as waves, if all of them are.
fn waves(stage: &Stage, latent_size: usize) -> Option<Vec<Wave>> {
    let Activation::Sine { w0 } = stage.activation else { return None };
    let forms = &stage.forms;
    (0..forms.len())
        .map(|i| {
            let (place, weight) = match &forms.core {
                Core::Units(units) => (units[i].place, 1.0),
                Core::Rows(blocks) => {
                    let row = &blocks[0].weights[i * blocks[0].units..(i + 1) * blocks[0].units];
                    let place = row.iter().position(|&w| w != 0.0)?;
                    row[place + 1..].iter().all(|&w| w == 0.0).then_some((place, row[place]))?
                }
            };
            let (rate, phase) = (f64::from(w0) * forms.scale[i] * weight, f64::from(w0) * forms.shift[i]);
            let cosine = (phase - FRAC_PI_2).abs() < SAME_PHASE;
            let sign = if cosine || rate > 0.0 { 1.0 } else { -1.0 };
            let wave = Wave { axis: place.checked_sub(latent_size)?, frequency: rate.abs(), cosine, sign };
            (rate != 0.0 && rate.is_finite() && (cosine || phase == 0.0)).then_some(wave)
        })
        .collect()
}

/// Where everything goes.
struct Plan<'a> {
    stages: &'a Stages,
    parents: Vec<Vec<usize>>,
    depths: Vec<usize>,
    places: Places,
    /// Number of inputs, the encoding included.
    input: usize,
}

impl Plan<'_> {
    fn layers(&self, budget: &mut Budget) -> Result<Vec<Layer>, FieldError> {
        let deepest = self.depths.iter().copied().max().unwrap_or(0);
        if deepest > MAX_LAYERS {
            let (found, limit) = (deepest as u64, MAX_LAYERS as u64);
            return Err(FieldError::Limit { what: "layers of a network", found, limit });
        }
        // the first unit of every stage in its layer
        let mut starts = vec![0; self.depths.len()];
        let (mut layers, mut previous, mut parameters) = (Vec::new(), 0, 0);
        for depth in 1..=deepest {
            let members: Vec<usize> = (0..self.depths.len()).filter(|&i| self.depths[i] == depth).collect();
            let mut outputs = 0;
            for &i in &members {
                starts[i] = outputs;
                outputs += self.stages.list[i].forms.len();
            }
            let is_input = |&parent: &usize| parent == 0 || self.places[parent - 1].is_some();
            let sees_input = depth == 1 || members.iter().any(|&i| self.parents[i].iter().any(is_input));
            let inputs = previous + if sees_input { self.input } else { 0 };
            parameters += outputs.saturating_mul(inputs + 1);
            if parameters > MAX_PARAMETERS {
                let (found, limit) = (parameters as u64, MAX_PARAMETERS as u64);
                return Err(FieldError::Limit { what: "parameters of a network", found, limit });
            }
            budget.numbers(outputs * inputs)?;
            let activation = self.activation(&members)?;
            let mut layer = Layer {
                weights: vec![0.0; outputs * inputs],
                bias: Vec::with_capacity(outputs),
                norm: None,
                activation,
                skip: (sees_input && depth > 1).then_some(Skip { scale: 1.0 }),
            };
            for &i in &members {
                self.fill(&mut layer, &self.stages.list[i], starts[i], [inputs, previous], &starts);
            }
            layers.push(layer);
            previous = outputs;
        }
        Ok(layers)
    }

    /// The one activation of the stages of a layer. Sines of different frequencies become sines of frequency 1.
    fn activation(&self, members: &[usize]) -> Result<Activation, FieldError> {
        let first = &self.stages.list[members[0]];
        let mut activation = first.activation;
        for stage in members[1..].iter().map(|&i| &self.stages.list[i]) {
            match (stage.activation, activation) {
                (a, b) if a == b => {}
                (Activation::Sine { .. }, Activation::Sine { .. }) => activation = Activation::Sine { w0: 1.0 },
                _ => {
                    let detail = format!("{} and {} in one layer", first.title, stage.title);
                    return Err(FieldError::Unsupported { detail });
                }
            }
        }
        Ok(activation)
    }

    /// Writes the rows of a stage, from row `start` of its layer on.
    fn fill(&self, layer: &mut Layer, stage: &Stage, start: usize, [inputs, previous]: [usize; 2], starts: &[usize]) {
        let gain = match (stage.activation, layer.activation) {
            (Activation::Sine { w0 }, Activation::Sine { w0: common }) => f64::from(w0) / f64::from(common),
            _ => 1.0,
        };
        let column = |unit: Unit| match unit.stage.checked_sub(1) {
            // the coordinates stand before their sines, so the inputs keep their places
            None => (previous + unit.place, 1.0),
            Some(parent) => match &self.places[parent] {
                Some(places) => (previous + places[unit.place].0, places[unit.place].1),
                None => (starts[parent] + unit.place, 1.0),
            },
        };
        let forms = &stage.forms;
        layer.bias.extend(forms.shift.iter().map(|shift| (gain * shift) as f32));
        let rows = &mut layer.weights[start * inputs..(start + forms.len()) * inputs];
        match &forms.core {
            Core::Units(units) => {
                for ((row, &unit), scale) in rows.chunks_exact_mut(inputs).zip(units.iter()).zip(&forms.scale) {
                    if *scale != 0.0 {
                        let (column, sign) = column(unit);
                        row[column] += (gain * scale * sign) as f32;
                    }
                }
            }
            Core::Rows(blocks) => {
                for block in blocks.iter() {
                    let columns: Vec<(usize, f64)> =
                        (0..block.units).map(|place| column(Unit { stage: block.stage, place })).collect();
                    let weights = block.weights.chunks_exact(block.units);
                    for ((row, weights), scale) in rows.chunks_exact_mut(inputs).zip(weights).zip(&forms.scale) {
                        for (&weight, &(column, sign)) in weights.iter().zip(&columns) {
                            row[column] += (gain * scale * weight * sign) as f32;
                        }
                    }
                }
            }
        }
    }
}
