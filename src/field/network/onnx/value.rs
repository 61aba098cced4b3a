//! What flows along an edge of the graph.
//!
//! A value has *leading* axes, which count points and are never looked into, and axes of its own. A constant has no leading axes; a
//! constant that was repeated for every point is a list of forms without units.

use super::budget::Budget;
use super::forms::Forms;
use super::shapes;
use super::tensor::Tensor;
use crate::field::FieldError;
use std::rc::Rc;

/// Length of a leading axis, `None` where it is not known.
pub(super) type Lead = Vec<Option<u64>>;

/// A value of the graph.
#[derive(Clone, Debug)]
pub(super) enum Value {
    /// Known numbers. In a list of lengths one that is not known is not a number (NaN); no other number is.
    Constant(Rc<Tensor>),
    /// Numbers that differ from point to point.
    Varying(Varying),
    /// Whether numbers that differ from point to point are over a threshold.
    Over(Varying, f64),
}

/// A tensor of forms.
#[derive(Clone, Debug)]
pub(super) struct Varying {
    pub lead: Lead,
    pub shape: Vec<usize>,
    pub forms: Rc<Forms>,
}

impl Varying {
    pub(super) fn rank(&self) -> usize {
        self.lead.len() + self.shape.len()
    }

    pub(super) fn axes(&self) -> Axes {
        (self.lead.clone(), self.shape.clone())
    }

    /// The same leading axes with other forms.
    pub(super) fn with(&self, shape: Vec<usize>, forms: Forms) -> Self {
        Self { lead: self.lead.clone(), shape, forms: Rc::new(forms) }
    }

    /// The same leading axes with some of the forms.
    pub(super) fn take(&self, shape: Vec<usize>, places: &[usize], budget: &mut Budget) -> Result<Self, FieldError> {
        Ok(self.with(shape, self.forms.take(places, budget)?))
    }

    /// A constant that is the same for every point, as forms.
    pub(super) fn repeated(tensor: &Tensor, lead: Lead, budget: &mut Budget) -> Result<Self, FieldError> {
        budget.numbers(3 * tensor.numbers.len())?;
        Ok(Self { lead, shape: tensor.shape.clone(), forms: Rc::new(Forms::constant(tensor.numbers.clone())) })
    }
}

impl Tensor {
    /// A list or a single number of whole numbers.
    pub(super) fn whole(shape: Vec<usize>, numbers: Vec<f64>) -> Self {
        Self { shape, integer: true, numbers }
    }

    pub(super) fn len(&self) -> usize {
        self.numbers.len()
    }

    /// The numbers at some places.
    pub(super) fn take(&self, shape: Vec<usize>, places: &[usize], budget: &mut Budget) -> Result<Self, FieldError> {
        budget.numbers(places.len())?;
        let numbers = places.iter().map(|&p| self.numbers[p]).collect();
        Ok(Self { shape, integer: self.integer, numbers })
    }

    /// The last `rank` axes, where all that comes before is of length 1 or a repetition: a constant beside something that
    /// has that many axes of its own. `None` where it differs from point to point.
    pub(super) fn last_axes(&self, rank: usize, budget: &mut Budget) -> Result<Option<Self>, FieldError> {
        budget.numbers(self.len())?;
        let extra = self.shape.len().saturating_sub(rank);
        if extra == 0 {
            return Ok(Some(self.clone()));
        }
        let shape = self.shape[extra..].to_vec();
        let Some(first) = shapes::count(&shape).and_then(|size| self.numbers.get(..size)) else {
            return Ok(None);
        };
        if first.is_empty() || self.numbers.chunks_exact(first.len()).any(|row| row != first) {
            return Ok(None);
        }
        Ok(Some(Self { shape, integer: self.integer, numbers: first.to_vec() }))
    }
}

/// The leading axes of two values that are broadcast to each other, aligned at the end. `None` where they differ, and where
/// either is repeated along an axis of the other: that would be pairs of points.
pub(super) fn join_leads(a: &[Option<u64>], b: &[Option<u64>]) -> Option<Lead> {
    let rank = a.len().max(b.len());
    let (mut repeats_a, mut repeats_b) = (false, false);
    let joined = (0..rank)
        .map(|i| {
            let of = |lead: &[Option<u64>]| (i + lead.len()).checked_sub(rank).map_or(Some(1), |at| lead[at]);
            match (of(a), of(b)) {
                (Some(1), Some(1)) => Some(Some(1)),
                (Some(1), other) => {
                    repeats_a = true;
                    Some(other)
                }
                (other, Some(1)) => {
                    repeats_b = true;
                    Some(other)
                }
                (Some(x), Some(y)) => (x == y).then_some(Some(x)),
                _ => Some(None),
            }
        })
        .collect();
    if repeats_a && repeats_b { None } else { joined }
}

/// Leading axes and axes of its own.
pub(super) type Axes = (Lead, Vec<usize>);

/// The same tensor with so many axes of its own, if only axes of length 1 have to change sides.
pub(super) fn with_own_rank((lead, shape): &Axes, rank: usize) -> Option<Axes> {
    let (mut lead, mut shape) = (lead.clone(), shape.clone());
    if let Some(extra) = shape.len().checked_sub(rank) {
        if shape.drain(..extra).any(|length| length != 1) {
            return None;
        }
        lead.extend(std::iter::repeat_n(Some(1), extra));
    } else {
        while shape.len() < rank {
            // beyond the first axis there are as many of length 1 as one wants
            if lead.pop().unwrap_or(Some(1)) != Some(1) {
                return None;
            }
            shape.insert(0, 1);
        }
    }
    Some((lead, shape))
}

/// Gives both the same number of axes of their own.
pub(super) fn same_own_rank(a: &Axes, b: &Axes) -> Option<[Axes; 2]> {
    let lower = |from: &Axes, to: &Axes| with_own_rank(from, to.1.len());
    lower(a, b).map(|a| [a, b.clone()]).or_else(|| lower(b, a).map(|b| [a.clone(), b]))
}

/// Two values as tensors of the same shape.
pub(super) struct Aligned {
    pub lead: Lead,
    pub shape: Vec<usize>,
    /// Which element of the first and of the second every element comes from.
    pub places: [Vec<usize>; 2],
}

/// Broadcasts two shapes behind their leading axes; `None` where they do not fit or points would meet columns.
pub(super) fn align(a: &Axes, b: &Axes, budget: &mut Budget) -> Result<Option<Aligned>, FieldError> {
    let Some([a, b]) = same_own_rank(a, b) else {
        return Ok(None);
    };
    let (Some(lead), Some(shape)) = (join_leads(&a.0, &b.0), shapes::broadcast(&a.1, &b.1)) else {
        return Ok(None);
    };
    budget.numbers(shapes::count(&shape).unwrap_or(usize::MAX).saturating_mul(2))?;
    let places = [shapes::broadcast_indices(&a.1, &shape), shapes::broadcast_indices(&b.1, &shape)];
    Ok(Some(Aligned { lead, shape, places }))
}
