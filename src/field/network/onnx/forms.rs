//! Affine forms in units: the network's inputs and the outputs of activations.
//!
//! A list of forms is `scale * core + shift`, form by form, where the core is a unit or a row of weights over the units of one or
//! more stages. Scaling, shifting and picking leave the core alone, so a chain of them costs no more than its length.

use super::budget::Budget;
use super::stages::Stages;
use crate::field::FieldError;
use std::rc::Rc;

/// One number that the network has at a point.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Unit {
    /// 0 for the inputs; the activations follow in their order.
    pub stage: usize,
    /// Place in the stage.
    pub place: usize,
}

/// Weights over all units of a stage, a row for every form.
#[derive(Debug)]
pub(super) struct Block {
    pub stage: usize,
    /// Units of the stage.
    pub units: usize,
    /// Row-major.
    pub weights: Vec<f64>,
}

/// What is scaled and shifted.
#[derive(Clone, Debug)]
pub(super) enum Core {
    /// A unit for every form.
    Units(Rc<Vec<Unit>>),
    /// A sum over blocks of different stages.
    Rows(Rc<Vec<Block>>),
}

/// A list of affine forms.
#[derive(Clone, Debug)]
pub(super) struct Forms {
    /// 0 for a form that is constant; its part of the core means nothing then.
    pub scale: Vec<f64>,
    pub shift: Vec<f64>,
    pub core: Core,
}

impl Forms {
    /// The units of a stage.
    pub(super) fn units(stage: usize, places: std::ops::Range<usize>) -> Self {
        let units: Vec<Unit> = places.map(|place| Unit { stage, place }).collect();
        Self { scale: vec![1.0; units.len()], shift: vec![0.0; units.len()], core: Core::Units(Rc::new(units)) }
    }

    /// Forms that are constant.
    pub(super) fn constant(numbers: Vec<f64>) -> Self {
        let units = vec![Unit { stage: 0, place: 0 }; numbers.len()];
        Self { scale: vec![0.0; numbers.len()], shift: numbers, core: Core::Units(Rc::new(units)) }
    }

    pub(super) fn len(&self) -> usize {
        self.shift.len()
    }

    pub(super) fn is_constant(&self) -> bool {
        self.scale.iter().all(|&scale| scale == 0.0)
    }

    /// The forms at some places, in that order.
    pub(super) fn take(&self, places: &[usize], budget: &mut Budget) -> Result<Self, FieldError> {
        budget.numbers(2 * places.len())?;
        let core = match &self.core {
            core if places.len() == self.len() && places.iter().enumerate().all(|(i, &p)| i == p) => core.clone(),
            Core::Units(units) => Core::Units(Rc::new(places.iter().map(|&p| units[p]).collect())),
            Core::Rows(blocks) => {
                let mut taken = Vec::with_capacity(blocks.len());
                for block in blocks.iter() {
                    budget.numbers(places.len().saturating_mul(block.units))?;
                    let rows = places.iter().flat_map(|&p| &block.weights[p * block.units..(p + 1) * block.units]);
                    taken.push(Block { weights: rows.copied().collect(), ..*block });
                }
                Core::Rows(Rc::new(taken))
            }
        };
        let of = |list: &[f64]| places.iter().map(|&p| list[p]).collect();
        Ok(Self { scale: of(&self.scale), shift: of(&self.shift), core })
    }

    /// `factor * form + summand`, form by form.
    pub(super) fn scaled(&self, factors: &[f64], summands: &[f64]) -> Self {
        Self {
            scale: self.scale.iter().zip(factors).map(|(s, f)| s * f).collect(),
            shift: self.shift.iter().zip(factors).zip(summands).map(|((s, f), a)| s * f + a).collect(),
            core: self.core.clone(),
        }
    }

    /// The sum, form by form.
    pub(super) fn plus(&self, other: &Self, stages: &Stages, budget: &mut Budget) -> Result<Self, FieldError> {
        budget.numbers(2 * self.len())?;
        let shift: Vec<f64> = self.shift.iter().zip(&other.shift).map(|(a, b)| a + b).collect();
        if other.is_constant() {
            return Ok(Self { scale: self.scale.clone(), shift, core: self.core.clone() });
        }
        if self.is_constant() {
            return Ok(Self { scale: other.scale.clone(), shift, core: other.core.clone() });
        }
        let mut blocks = self.rows(stages, budget)?;
        for block in other.rows(stages, budget)? {
            match blocks.iter_mut().find(|b| b.stage == block.stage) {
                Some(found) => found.weights.iter_mut().zip(&block.weights).for_each(|(a, b)| *a += b),
                None => blocks.push(block),
            }
        }
        Ok(Self { scale: vec![1.0; shift.len()], shift, core: Core::Rows(Rc::new(blocks)) })
    }

    /// The forms of several lists, one list after the other.
    pub(super) fn joined(lists: &[Rc<Self>], stages: &Stages, budget: &mut Budget) -> Result<Self, FieldError> {
        let length: usize = lists.iter().map(|l| l.len()).sum();
        budget.numbers(3 * length)?;
        let shift = lists.iter().flat_map(|l| &l.shift).copied().collect();
        let picked = |list: &Rc<Self>| match &list.core {
            Core::Units(units) => Some(units.clone()),
            Core::Rows(_) => None,
        };
        if let Some(units) = lists.iter().map(picked).collect::<Option<Vec<_>>>() {
            let core = Core::Units(Rc::new(units.iter().flat_map(|u| u.iter()).copied().collect()));
            return Ok(Self { scale: lists.iter().flat_map(|l| &l.scale).copied().collect(), shift, core });
        }
        let mut blocks: Vec<Block> = Vec::new();
        let mut start = 0;
        for list in lists {
            for part in list.rows(stages, budget)? {
                let units = part.units;
                let at = match blocks.iter().position(|b| b.stage == part.stage) {
                    Some(at) => at,
                    None => {
                        budget.numbers(length.saturating_mul(units))?;
                        blocks.push(Block { stage: part.stage, units, weights: vec![0.0; length * units] });
                        blocks.len() - 1
                    }
                };
                blocks[at].weights[start * units..][..part.weights.len()].copy_from_slice(&part.weights);
            }
            start += list.len();
        }
        Ok(Self { scale: vec![1.0; length], shift, core: Core::Rows(Rc::new(blocks)) })
    }

    /// The forms as sums of weights, the scale multiplied in.
    fn rows(&self, stages: &Stages, budget: &mut Budget) -> Result<Vec<Block>, FieldError> {
        match &self.core {
            Core::Rows(blocks) => {
                let mut scaled = Vec::with_capacity(blocks.len());
                for block in blocks.iter() {
                    budget.numbers(block.weights.len())?;
                    let rows = block.weights.chunks_exact(block.units).zip(&self.scale);
                    let weights = rows.flat_map(|(row, &scale)| row.iter().map(move |w| w * scale)).collect();
                    scaled.push(Block { weights, ..*block });
                }
                Ok(scaled)
            }
            Core::Units(units) => {
                let mut blocks = Blocks::new(self.len());
                for (row, (unit, &scale)) in units.iter().zip(&self.scale).enumerate() {
                    if scale != 0.0 {
                        let block = blocks.of(unit.stage, stages, budget)?;
                        block.weights[row * block.units + unit.place] = scale;
                    }
                }
                Ok(blocks.list)
            }
        }
    }

    /// The forms times a matrix: taken as `groups` vectors of `inner` forms, each is multiplied by `matrix`, which has
    /// `inner` rows of `outer` numbers.
    pub(super) fn times(
        &self,
        matrix: &[f64],
        [groups, inner, outer]: [usize; 3],
        stages: &Stages,
        budget: &mut Budget,
    ) -> Result<Self, FieldError> {
        let length = groups.saturating_mul(outer);
        budget.numbers(length.saturating_mul(2))?;
        budget.work(length.saturating_mul(inner))?;
        let mut shift = vec![0.0; length];
        for group in 0..groups {
            let sums = &mut shift[group * outer..(group + 1) * outer];
            for (k, row) in matrix.chunks_exact(outer.max(1)).enumerate() {
                let constant = self.shift[group * inner + k];
                sums.iter_mut().zip(row).for_each(|(sum, w)| *sum += constant * w);
            }
        }
        let mut result = Blocks::new(length);
        match &self.core {
            Core::Units(units) => {
                for (at, (unit, &scale)) in units.iter().zip(&self.scale).enumerate() {
                    if scale == 0.0 {
                        continue;
                    }
                    let (group, k) = (at / inner, at % inner);
                    let block = result.of(unit.stage, stages, budget)?;
                    let column = block.weights[unit.place..].iter_mut().step_by(block.units).skip(group * outer);
                    column.zip(&matrix[k * outer..(k + 1) * outer]).for_each(|(sum, w)| *sum += scale * w);
                }
            }
            Core::Rows(blocks) => {
                for from in blocks.iter() {
                    budget.work(length.saturating_mul(inner).saturating_mul(from.units))?;
                    let to = result.of(from.stage, stages, budget)?;
                    for (row, sums) in to.weights.chunks_exact_mut(from.units).enumerate() {
                        let (group, j) = (row / outer, row % outer);
                        for k in 0..inner {
                            let at = group * inner + k;
                            let factor = self.scale[at] * matrix[k * outer + j];
                            let weights = &from.weights[at * from.units..(at + 1) * from.units];
                            sums.iter_mut().zip(weights).for_each(|(sum, w)| *sum += factor * w);
                        }
                    }
                }
            }
        }
        Ok(Self { scale: vec![1.0; length], shift, core: Core::Rows(Rc::new(result.list)) })
    }

    /// How many multiplications [`times`](Self::times) takes.
    pub(super) fn cost_of_times(&self, outer: usize) -> usize {
        let units = match &self.core {
            Core::Units(_) => 1,
            Core::Rows(blocks) => blocks.iter().map(|b| b.units).sum::<usize>() + 1,
        };
        self.len().saturating_mul(outer).saturating_mul(units)
    }

    /// Whether the cores are the same ones, not only equal in value: one was made of the other by scaling and shifting.
    pub(super) fn same_core(&self, other: &Self) -> bool {
        match (&self.core, &other.core) {
            (Core::Units(a), Core::Units(b)) => Rc::ptr_eq(a, b) || a == b,
            (Core::Rows(a), Core::Rows(b)) => Rc::ptr_eq(a, b),
            _ => false,
        }
    }
}

/// Blocks of the same number of rows that are made when the first weight comes.
struct Blocks {
    rows: usize,
    list: Vec<Block>,
}

impl Blocks {
    fn new(rows: usize) -> Self {
        Self { rows, list: Vec::new() }
    }

    fn of(&mut self, stage: usize, stages: &Stages, budget: &mut Budget) -> Result<&mut Block, FieldError> {
        let at = match self.list.iter().position(|b| b.stage == stage) {
            Some(at) => at,
            None => {
                let units = stages.units(stage);
                let size = self.rows.saturating_mul(units);
                budget.numbers(size)?;
                self.list.push(Block { stage, units, weights: vec![0.0; size] });
                self.list.len() - 1
            }
        };
        Ok(&mut self.list[at])
    }
}
