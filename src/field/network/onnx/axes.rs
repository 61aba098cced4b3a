//! Operators that give the same numbers other axes, or repeat them.

use super::operators::{Call, known, one};
use super::shapes;
use super::structure::{axes, kept, known_end, lengths};
use super::tensor::Tensor;
use super::value::{Lead, Value, Varying, join_leads, with_own_rank};
use crate::field::FieldError;
use std::rc::Rc;

pub(super) fn transpose(call: &mut Call<'_, '_>) -> Result<Vec<Value>, FieldError> {
    let value = call.argument(0)?;
    let rank = axes(call, &value)?.len();
    let order: Vec<usize> = match call.ints("perm")? {
        None => (0..rank).rev().collect(),
        Some(list) => list.iter().filter_map(|&axis| usize::try_from(axis).ok()).collect(),
    };
    let mut sorted = order.clone();
    sorted.sort_unstable();
    if !sorted.iter().copied().eq(0..rank) {
        return Err(call.fault(&format!("an order that is none of {rank} axes")));
    }
    match value {
        Value::Constant(constant) => {
            call.budget.numbers(constant.len())?;
            let shape = order.iter().map(|&axis| constant.shape[axis]).collect();
            known(constant.take(shape, &shapes::permuted_indices(&constant.shape, &order), call.budget)?)
        }
        Value::Varying(varying) => {
            let leading = varying.lead.len();
            if order[..leading].iter().enumerate().any(|(i, &axis)| i != axis) {
                return Err(call.refused("of points with columns"));
            }
            let order: Vec<usize> = order[leading..].iter().map(|axis| axis - leading).collect();
            call.budget.numbers(varying.forms.len())?;
            let shape = order.iter().map(|&axis| varying.shape[axis]).collect();
            one(Value::Varying(varying.take(shape, &shapes::permuted_indices(&varying.shape, &order), call.budget)?))
        }
        Value::Over(..) => Err(call.refused("of truth values")),
    }
}

pub(super) fn reshape(call: &mut Call<'_, '_>) -> Result<Vec<Value>, FieldError> {
    let (value, wanted) = (call.argument(0)?, call.tensor(1)?);
    let old = axes(call, &value)?;
    if wanted.len() > super::model::MAX_AXES {
        return Err(call.fault(&format!("a shape of {} axes", wanted.len())));
    }
    let copies = call.int("allowzero", 0)? == 0;
    let mut target = Vec::with_capacity(wanted.len());
    for (i, &length) in wanted.numbers.iter().enumerate() {
        target.push(match length {
            0.0 if copies => {
                let copied = old.get(i).ok_or_else(|| call.fault(&format!("a copy of axis {i} of {}", old.len())))?;
                copied.map_or(f64::NAN, |l| l as f64)
            }
            length if length < -1.0 => return Err(call.fault(&format!("an axis of length {length}"))),
            length => length,
        });
    }
    match value {
        Value::Constant(constant) => {
            let shape = resolved(&target, constant.len());
            let shape =
                shape.ok_or_else(|| call.fault(&format!("a shape that does not hold {} numbers", constant.len())))?;
            one(Value::Constant(Rc::new(Tensor { shape, ..Rc::unwrap_or_clone(constant) })))
        }
        Value::Varying(varying) => {
            let resolved = columns_of(&target, &varying);
            let (lead, shape) =
                resolved.ok_or_else(|| call.refused("to a shape in which points and columns are mixed"))?;
            one(Value::Varying(Varying { lead, shape, forms: varying.forms }))
        }
        Value::Over(..) => Err(call.refused("of truth values")),
    }
}

/// A shape with at most one length of -1 for so many numbers.
fn resolved(target: &[f64], count: usize) -> Option<Vec<usize>> {
    let given = target
        .iter()
        .filter(|&&l| l != -1.0)
        .try_fold(1usize, |p, &l| if l.is_nan() { None } else { p.checked_mul(l as usize) })?;
    let missing = match target.iter().filter(|&&l| l == -1.0).count() {
        0 => (given == count).then_some(1)?,
        1 => count.checked_div(given).filter(|m| m * given == count)?,
        _ => return None,
    };
    Some(target.iter().map(|&l| if l == -1.0 { missing } else { l as usize }).collect())
}

/// Which of the new axes are those of the points: at the end there must be axes that hold the columns of one point.
fn columns_of(target: &[f64], varying: &Varying) -> Option<(Lead, Vec<usize>)> {
    let size = varying.forms.len();
    let (mut at, mut held) = (target.len(), 1usize);
    while held != size && at > 0 && target[at - 1] >= 1.0 {
        at -= 1;
        held = held.checked_mul(target[at] as usize)?;
    }
    let mut shape: Vec<usize> = target[at..].iter().map(|&l| l as usize).collect();
    let lead = if held == size {
        // further axes of length 1 may belong to the columns, but for one that is left to the points
        while at > 1 && target[at - 1] == 1.0 {
            at -= 1;
            shape.insert(0, 1);
        }
        &target[..at]
    } else {
        // -1 stands for what is left of the columns if all the points are counted before it
        if at == 0 || target[at - 1] != -1.0 || !size.is_multiple_of(held.max(1)) {
            return None;
        }
        let lead = &target[..at - 1];
        let points = |lengths: &[Option<u64>]| {
            let known: Option<u64> = lengths.iter().flatten().try_fold(1u64, |p, &l| p.checked_mul(l));
            Some((known?, lengths.iter().filter(|l| l.is_none()).count()))
        };
        let new: Lead = lead.iter().map(|&l| if l.is_nan() { None } else { Some(l as u64) }).collect();
        if points(&new)? != points(&varying.lead)? {
            return None;
        }
        shape.insert(0, size / held.max(1));
        lead
    };
    if lead.iter().filter(|&&l| l == -1.0).count() > 1 {
        return None;
    }
    Some((lead.iter().map(|&l| if l >= 0.0 { Some(l as u64) } else { None }).collect(), shape))
}

pub(super) fn flatten(call: &mut Call<'_, '_>) -> Result<Vec<Value>, FieldError> {
    let value = call.argument(0)?;
    let rank = axes(call, &value)?.len();
    let number = call.int("axis", 1)?;
    let axis = if number == rank as i64 { Some(rank) } else { shapes::axis(number, rank) };
    let axis = axis.ok_or_else(|| call.fault(&format!("axis {number} of {rank}")))?;
    match value {
        Value::Constant(constant) => {
            let product = |part: &[usize]| shapes::count(part).ok_or_else(|| call.fault("axes too long to be joined"));
            let shape = vec![product(&constant.shape[..axis])?, product(&constant.shape[axis..])?];
            one(Value::Constant(Rc::new(Tensor { shape, ..Rc::unwrap_or_clone(constant) })))
        }
        Value::Varying(varying) if axis == varying.lead.len() => {
            let all = varying.lead.iter().copied().try_fold(1u64, |p, l| p.checked_mul(l?));
            let size = varying.forms.len();
            one(Value::Varying(Varying { lead: vec![all], shape: vec![size], forms: varying.forms }))
        }
        _ => Err(call.refused("to a shape in which points and columns are mixed")),
    }
}

pub(super) fn squeeze(call: &mut Call<'_, '_>) -> Result<Vec<Value>, FieldError> {
    let (value, listed) = (call.argument(0)?, call.list("axes", 1)?);
    let lengths = axes(call, &value)?;
    let mut gone: Vec<bool> = lengths.iter().map(|&l| listed.is_none() && l == Some(1)).collect();
    for number in listed.into_iter().flatten() {
        let axis = shapes::axis(number, lengths.len());
        let axis = axis.ok_or_else(|| call.fault(&format!("axis {number} of {}", lengths.len())))?;
        if lengths[axis] != Some(1) {
            return Err(call.refused(&format!("of axis {axis}, which is not of length 1")));
        }
        gone[axis] = true;
    }
    let left =
        |shape: &[usize], gone: &[bool]| shape.iter().zip(gone).filter(|(_, gone)| !**gone).map(|(&l, _)| l).collect();
    match value {
        Value::Constant(constant) => {
            let shape = left(&constant.shape, &gone);
            one(Value::Constant(Rc::new(Tensor { shape, ..Rc::unwrap_or_clone(constant) })))
        }
        Value::Varying(varying) => {
            let (leading, own) = gone.split_at(varying.lead.len());
            let lead = varying.lead.iter().zip(leading).filter(|(_, gone)| !**gone).map(|(&l, _)| l).collect();
            one(Value::Varying(Varying { lead, shape: left(&varying.shape, own), forms: varying.forms }))
        }
        Value::Over(..) => Err(call.refused("of truth values")),
    }
}

pub(super) fn unsqueeze(call: &mut Call<'_, '_>) -> Result<Vec<Value>, FieldError> {
    let value = call.argument(0)?;
    let Some(listed) = call.list("axes", 1)? else {
        return Err(call.fault("no axes"));
    };
    let rank = axes(call, &value)?.len() + listed.len();
    if rank > super::model::MAX_AXES {
        return Err(call.fault(&format!("a shape of {rank} axes")));
    }
    let mut new = vec![false; rank];
    for number in listed {
        let axis = shapes::axis(number, rank).filter(|&axis| !new[axis]);
        new[axis.ok_or_else(|| call.fault(&format!("axis {number} of {rank}")))?] = true;
    }
    match value {
        Value::Constant(constant) => {
            let mut old = constant.shape.iter();
            let shape = new.iter().map(|&new| if new { 1 } else { old.next().copied().unwrap_or(1) }).collect();
            one(Value::Constant(Rc::new(Tensor { shape, ..Rc::unwrap_or_clone(constant) })))
        }
        Value::Varying(varying) => {
            let (mut lead, mut shape) = (Lead::new(), Vec::new());
            let (mut points, mut own) = (varying.lead.iter(), varying.shape.iter());
            for new in new {
                // an axis between those of the points is one of them, another stands with the columns
                if !new {
                    match points.next() {
                        Some(&length) => lead.push(length),
                        None => shape.push(own.next().copied().unwrap_or(1)),
                    }
                } else if points.len() > 0 {
                    lead.push(Some(1));
                } else {
                    shape.push(1);
                }
            }
            one(Value::Varying(Varying { lead, shape, forms: varying.forms }))
        }
        Value::Over(..) => Err(call.refused("of truth values")),
    }
}

pub(super) fn expand(call: &mut Call<'_, '_>) -> Result<Vec<Value>, FieldError> {
    let target = lengths(call, &call.tensor(1)?.numbers)?;
    let misfit = |call: &Call<'_, '_>| call.fault("a shape that the input cannot be repeated to");
    let varying = match call.argument(0)? {
        Value::Varying(varying) => varying,
        Value::Over(..) => return Err(call.refused("of truth values")),
        Value::Constant(constant) => {
            let end = known_end(&target);
            if end.len() == target.len() {
                let shape = shapes::broadcast(&constant.shape, &end).ok_or_else(|| misfit(call))?;
                call.budget.numbers(shapes::count(&shape).unwrap_or(usize::MAX))?;
                let places = shapes::broadcast_indices(&constant.shape, &shape);
                return known(constant.take(shape, &places, call.budget)?);
            }
            let last = constant.last_axes(end.len(), call.budget)?.filter(|l| l.numbers.iter().all(|v| v.is_finite()));
            let last = last.ok_or_else(|| call.refused("a constant that is another one for every point"))?;
            Varying::repeated(&last, Vec::new(), call.budget)?
        }
    };
    // the columns are repeated to the last known axes of the target, the points to what is before
    let mut axes = Some(varying.axes());
    let mut own = varying.shape.len().min(target.len());
    while own > 0 && target[target.len() - own..].iter().any(Option::is_none) {
        own -= 1;
        axes = axes.and_then(|axes| with_own_rank(&axes, own));
    }
    let (lead, shape) = axes.ok_or_else(|| misfit(call))?;
    let (points, columns) = target.split_at(target.len() - own);
    let columns = shapes::broadcast(&shape, &known_end(columns)).ok_or_else(|| misfit(call))?;
    // a length that is not known is the number of points: what has no point of its own is repeated for each
    let lead = join_leads(&lead, points).ok_or_else(|| misfit(call))?;
    call.budget.numbers(shapes::count(&columns).unwrap_or(usize::MAX))?;
    let places = shapes::broadcast_indices(&shape, &columns);
    let forms = varying.forms.take(&places, call.budget)?;
    one(Value::Varying(Varying { lead, shape: columns, forms: Rc::new(forms) }))
}

/// `Tile`: every axis so many times over.
pub(super) fn tile(call: &mut Call<'_, '_>) -> Result<Vec<Value>, FieldError> {
    let mut value = call.argument(0)?;
    let repeats = lengths(call, &call.tensor(1)?.numbers)?;
    if axes(call, &value)?.len() != repeats.len() {
        return Err(call.fault(&format!("{} numbers of repetitions", repeats.len())));
    }
    if let (Value::Constant(constant), Some(last)) = (&value, repeats.iter().rposition(Option::is_none)) {
        // repeated for every point, so the axes up to there are those of the points
        let inner = constant.last_axes(repeats.len() - last - 1, call.budget)?;
        let inner = inner.filter(|l| l.numbers.iter().all(|v| v.is_finite()));
        let inner = inner.ok_or_else(|| call.refused("a constant that is another one for every point"))?;
        let lead = constant.shape[..=last].iter().map(|&length| Some(length as u64)).collect();
        value = Value::Varying(Varying::repeated(&inner, lead, call.budget)?);
    }
    for (axis, &repeat) in repeats.iter().enumerate() {
        if repeat == Some(1) {
            continue;
        }
        match &mut value {
            Value::Varying(varying) if axis < varying.lead.len() => {
                if varying.lead[axis] != Some(1) {
                    return Err(call.refused("of the points"));
                }
                varying.lead[axis] = repeat;
            }
            _ => {
                let length = axes(call, &value)?[axis].unwrap_or(0) as usize;
                let repeat = repeat.ok_or_else(|| call.refused("of the columns as often as there are points"))?;
                let count = usize::try_from(repeat).unwrap_or(usize::MAX).saturating_mul(length.max(1));
                call.budget.numbers(count)?;
                let places: Vec<usize> = (0..repeat).flat_map(|_| 0..length).collect();
                value = kept(call, &value, axis, &places)?;
            }
        }
    }
    one(value)
}
