//! Operators that compute nothing: constants, and choosing, joining and reordering what is there.

use super::forms::Forms;
use super::operators::{Call, known, one};
use super::shapes;
use super::tensor::Tensor;
use super::value::{Lead, Value, Varying, join_leads, with_own_rank};
use crate::field::FieldError;
use std::rc::Rc;

/// An end of a slice that is meant to be the axis's: exporters write the largest number of 32 or of 64 bits.
const OPEN_END: i64 = i32::MAX as i64;

/// `Identity`, `Dropout` (which does nothing but in training), and casts. Half precision is worked out as single precision.
pub(super) fn same(call: &mut Call<'_, '_>) -> Result<Vec<Value>, FieldError> {
    let integer = match call.node.operator {
        "Cast" => match call.int("to", 0)? {
            1 | 10 | 11 | 16 => Some(false),
            6 | 7 | 9 => Some(true),
            other => return Err(call.refused(&format!("to the type {other}"))),
        },
        "CastLike" => match call.argument(1)? {
            Value::Constant(like) => Some(like.integer),
            Value::Varying(_) => Some(false),
            Value::Over(..) => return Err(call.refused("of truth values")),
        },
        _ => None,
    };
    let to_truth = call.node.operator == "Cast" && call.int("to", 0)? == 9;
    match (call.argument(0)?, integer) {
        (value, None) => one(value),
        (Value::Constant(constant), Some(integer)) => {
            if constant.integer == integer && !to_truth {
                return one(Value::Constant(constant));
            }
            call.budget.numbers(constant.len())?;
            let cast = |&v: &f64| match (integer, to_truth) {
                (true, true) => f64::from(u8::from(v != 0.0)),
                (true, false) => v.trunc(),
                _ => v,
            };
            let numbers: Vec<f64> = constant.numbers.iter().map(cast).collect();
            if !integer && numbers.iter().any(|v| v.is_nan()) {
                return Err(call.refused("computing with the number of points"));
            }
            known(Tensor { shape: constant.shape.clone(), integer, numbers })
        }
        (value @ Value::Varying(_), Some(false)) => one(value),
        _ => Err(call.refused("of a value that depends on the point")),
    }
}

/// `Constant`, in whichever attribute the numbers are.
pub(super) fn constant(call: &mut Call<'_, '_>) -> Result<Vec<Value>, FieldError> {
    for name in ["value", "value_float", "value_floats", "value_int", "value_ints"] {
        if let Some(tensor) = call.held(name)? {
            return known(tensor);
        }
    }
    Err(call.refused("without numbers"))
}

/// A shape as an operator takes it: one axis of whole numbers that are not negative, or not known.
pub(super) fn lengths(call: &Call<'_, '_>, numbers: &[f64]) -> Result<Lead, FieldError> {
    let length = |&v: &f64| match v {
        v if v.is_nan() => Ok(None),
        v if v >= 0.0 => Ok(Some(v as u64)),
        v => Err(call.fault(&format!("an axis of length {v}"))),
    };
    numbers.iter().map(length).collect()
}

/// The axes after the last one whose length is not known.
pub(super) fn known_end(lengths: &[Option<u64>]) -> Vec<usize> {
    let known: Vec<usize> =
        lengths.iter().rev().map_while(|l| l.map(|l| usize::try_from(l).unwrap_or(usize::MAX))).collect();
    known.into_iter().rev().collect()
}

pub(super) fn constant_of_shape(call: &mut Call<'_, '_>) -> Result<Vec<Value>, FieldError> {
    let mut lead = lengths(call, &call.tensor(0)?.numbers)?;
    let shape = known_end(&lead);
    lead.truncate(lead.len() - shape.len());
    let (number, integer) = match call.held("value")? {
        None => (0.0, false),
        Some(held) if held.len() == 1 => (held.numbers[0], held.integer),
        Some(_) => return Err(call.fault("more than one value")),
    };
    let size = shapes::count(&shape).unwrap_or(usize::MAX);
    call.budget.numbers(size)?;
    let tensor = Tensor { shape, integer, numbers: vec![number; size] };
    if lead.is_empty() {
        return known(tensor);
    }
    one(Value::Varying(Varying::repeated(&tensor, lead, call.budget)?))
}

pub(super) fn range(call: &mut Call<'_, '_>) -> Result<Vec<Value>, FieldError> {
    let number = |call: &Call<'_, '_>, at| match call.tensor(at)?.numbers.as_slice() {
        [number] if !number.is_nan() => Ok(*number),
        _ => Err(call.refused("a range as long as there are points")),
    };
    let (start, end, step) = (number(call, 0)?, number(call, 1)?, number(call, 2)?);
    let count = ((end - start) / step).ceil().max(0.0);
    if !count.is_finite() {
        return Err(call.fault("a range without end"));
    }
    let count = count as usize;
    call.budget.numbers(count)?;
    let numbers = (0..count).map(|i| start + i as f64 * step).collect();
    known(Tensor { shape: vec![count], integer: call.tensor(0)?.integer, numbers })
}

pub(super) fn shape(call: &mut Call<'_, '_>) -> Result<Vec<Value>, FieldError> {
    let lengths: Vec<f64> = match call.argument(0)? {
        Value::Constant(constant) => constant.shape.iter().map(|&l| l as f64).collect(),
        Value::Varying(varying) | Value::Over(varying, _) => {
            let lead = varying.lead.iter().map(|l| l.map_or(f64::NAN, |l| l as f64));
            lead.chain(varying.shape.iter().map(|&l| l as f64)).collect()
        }
    };
    let kept = shapes::slice(call.int("start", 0)?, call.int("end", i64::MAX)?, 1, lengths.len());
    let numbers: Vec<f64> = kept.unwrap_or_default().into_iter().map(|at| lengths[at]).collect();
    known(Tensor::whole(vec![numbers.len()], numbers))
}

/// The axis that the attribute names, of so many.
fn axis(call: &Call<'_, '_>, default: Option<i64>, rank: usize) -> Result<usize, FieldError> {
    let number = call.int("axis", default.unwrap_or(i64::MIN))?;
    shapes::axis(number, rank).ok_or_else(|| call.fault(&format!("axis {number} of {rank}")))
}

/// The same axis among those behind the leading ones.
pub(super) fn own_axis(call: &Call<'_, '_>, varying: &Varying, axis: usize) -> Result<usize, FieldError> {
    axis.checked_sub(varying.lead.len()).ok_or_else(|| call.refused("of some of the points"))
}

/// Where the elements of joined tensors are if they first stand one tensor after the other.
fn joined(call: &mut Call<'_, '_>, parts: &[Vec<usize>], axis: usize) -> Result<(Vec<usize>, Vec<usize>), FieldError> {
    let mut shape = parts[0].clone();
    let others =
        |part: &[usize]| part.iter().enumerate().filter(|(i, _)| *i != axis).map(|(_, &l)| l).collect::<Vec<_>>();
    if axis >= shape.len() || parts.iter().any(|part| part.len() != shape.len() || others(part) != others(&shape)) {
        return Err(call.fault("pieces of shapes that do not fit"));
    }
    shape[axis] = parts.iter().map(|part| part[axis]).fold(0, usize::saturating_add);
    call.budget.numbers(shapes::count(&shape).unwrap_or(usize::MAX))?;
    if shape.contains(&0) {
        return Ok((shape, Vec::new()));
    }
    let outer: usize = shape[..axis].iter().product();
    let inner: usize = shape[axis + 1..].iter().product();
    call.budget.work(outer.saturating_mul(parts.len()))?;
    let mut places = Vec::new();
    for o in 0..outer {
        let mut start = 0;
        for part in parts {
            let row = part[axis] * inner;
            places.extend(start + o * row..start + (o + 1) * row);
            start += outer * row;
        }
    }
    Ok((shape, places))
}

pub(super) fn concat(call: &mut Call<'_, '_>) -> Result<Vec<Value>, FieldError> {
    let values = (0..call.arguments.len()).map(|at| call.argument(at)).collect::<Result<Vec<_>, _>>()?;
    let constants = values.iter().map(|v| if let Value::Constant(c) = v { Some(c.clone()) } else { None });
    if let Some(constants) = constants.collect::<Option<Vec<_>>>() {
        let Some(first) = constants.first() else {
            return Err(call.fault("no pieces"));
        };
        let axis = axis(call, None, first.shape.len())?;
        let parts: Vec<Vec<usize>> = constants.iter().map(|c| c.shape.clone()).collect();
        let (shape, places) = joined(call, &parts, axis)?;
        call.budget.numbers(2 * places.len())?;
        let all: Vec<f64> = constants.iter().flat_map(|c| &c.numbers).copied().collect();
        let numbers = places.into_iter().map(|p| all[p]).collect();
        return known(Tensor { shape, integer: constants.iter().all(|c| c.integer), numbers });
    }
    // the constants among them take the axes of the one that varies and has the fewest of its own
    let varying = values.iter().filter_map(|v| if let Value::Varying(v) = v { Some(v) } else { None });
    let Some(model) = varying.min_by_key(|v| v.shape.len()).cloned() else {
        return Err(call.refused("of truth values"));
    };
    let axis = axis(call, None, model.rank())?;
    let axis = own_axis(call, &model, axis)?;
    let (mut lead, mut pieces) = (model.lead.clone(), Vec::with_capacity(values.len()));
    for value in &values {
        let (own, forms) = match value {
            Value::Varying(v) => (with_own_rank(&v.axes(), model.shape.len()), v.forms.clone()),
            Value::Constant(c) => {
                let last = c.last_axes(model.shape.len(), call.budget)?;
                let last = last.filter(|l| l.numbers.iter().all(|n| n.is_finite()));
                let last = last.ok_or_else(|| call.refused("a constant that is another one for every point"))?;
                call.budget.numbers(2 * last.len())?;
                (Some((Vec::new(), last.shape)), Rc::new(Forms::constant(last.numbers)))
            }
            Value::Over(..) => return Err(call.refused("of truth values")),
        };
        let own = own.and_then(|(l, shape)| Some((join_leads(&lead, &l)?, shape)));
        let Some((joined_lead, shape)) = own else {
            return Err(call.fault("pieces of shapes that do not fit"));
        };
        lead = joined_lead;
        pieces.push((shape, forms));
    }
    let (parts, forms): (Vec<_>, Vec<_>) = pieces.into_iter().unzip();
    let (shape, places) = joined(call, &parts, axis)?;
    let forms = Forms::joined(&forms, call.stages, call.budget)?.take(&places, call.budget)?;
    one(Value::Varying(Varying { lead, shape, forms: Rc::new(forms) }))
}

/// Some places of one axis, of a constant or of what depends on the point.
pub(super) fn kept(call: &mut Call<'_, '_>, value: &Value, axis: usize, kept: &[usize]) -> Result<Value, FieldError> {
    let (shape, own) = match value {
        Value::Constant(constant) => (&constant.shape, axis),
        Value::Varying(varying) => (&varying.shape, own_axis(call, varying, axis)?),
        Value::Over(..) => return Err(call.refused("of truth values")),
    };
    let mut result = shape.clone();
    result[own] = kept.len();
    call.budget.numbers(shapes::count(&result).unwrap_or(usize::MAX))?;
    let places = shapes::kept_indices(shape, own, kept);
    Ok(match value {
        Value::Constant(constant) => Value::Constant(Rc::new(constant.take(result, &places, call.budget)?)),
        Value::Varying(varying) => Value::Varying(varying.take(result, &places, call.budget)?),
        Value::Over(..) => return Err(call.refused("of truth values")),
    })
}

/// Number of axes, those of the points included, and the length of each where it is known.
pub(super) fn axes(call: &Call<'_, '_>, value: &Value) -> Result<Lead, FieldError> {
    match value {
        Value::Constant(constant) => Ok(constant.shape.iter().map(|&l| Some(l as u64)).collect()),
        Value::Varying(v) => Ok(v.lead.iter().copied().chain(v.shape.iter().map(|&l| Some(l as u64))).collect()),
        Value::Over(..) => Err(call.refused("of truth values")),
    }
}

pub(super) fn slice(call: &mut Call<'_, '_>) -> Result<Vec<Value>, FieldError> {
    let (starts, ends) = (call.list("starts", 1)?, call.list("ends", 2)?);
    let (Some(starts), Some(ends)) = (starts, ends) else {
        return Err(call.fault("no starts or no ends"));
    };
    let numbered = (0..starts.len() as i64).collect();
    let (numbers, steps) = (call.list("axes", 3)?.unwrap_or(numbered), call.list("steps", 4)?);
    let steps = steps.unwrap_or_else(|| vec![1; starts.len()]);
    if [ends.len(), numbers.len(), steps.len()] != [starts.len(); 3] || starts.len() > super::model::MAX_AXES {
        return Err(call.fault("starts, ends, axes and steps of different lengths"));
    }
    let mut value = call.argument(0)?;
    for (((start, end), number), step) in starts.into_iter().zip(ends).zip(numbers).zip(steps) {
        let lengths = axes(call, &value)?;
        let axis = shapes::axis(number, lengths.len());
        let axis = axis.ok_or_else(|| call.fault(&format!("axis {number} of {}", lengths.len())))?;
        let leading = if let Value::Varying(v) = &value { v.lead.len() } else { 0 };
        if axis < leading {
            let all = start == 0
                && step == 1
                && (end >= OPEN_END || lengths[axis].is_some_and(|l| end >= 0 && end as u64 >= l));
            if !all {
                return Err(call.refused("of some of the points"));
            }
            continue;
        }
        let length = lengths[axis].unwrap_or(0) as usize;
        call.budget.numbers(length)?;
        let places = shapes::slice(start, end, step, length);
        let places = places.ok_or_else(|| call.fault(&format!("a step of {step}")))?;
        value = kept(call, &value, axis, &places)?;
    }
    one(value)
}

pub(super) fn gather(call: &mut Call<'_, '_>) -> Result<Vec<Value>, FieldError> {
    let (value, indices) = (call.argument(0)?, call.tensor(1)?);
    let lengths = axes(call, &value)?;
    let axis = axis(call, Some(0), lengths.len())?;
    call.budget.numbers(indices.len())?;
    let wanted = call.whole(&indices.numbers)?;
    if let (Value::Varying(varying), true, true) = (&value, indices.shape.is_empty(), lengths[axis] == Some(1))
        && axis < varying.lead.len()
        && matches!(wanted[0], 0 | -1)
    {
        let mut lead = varying.lead.clone();
        lead.remove(axis);
        return one(Value::Varying(Varying { lead, ..varying.clone() }));
    }
    let length = lengths[axis].unwrap_or(0) as usize;
    let places = wanted.iter().map(|&i| shapes::axis(i, length)).collect::<Option<Vec<usize>>>();
    let leading = if let Value::Varying(v) = &value { v.lead.len() } else { 0 };
    if axis < leading {
        return Err(call.refused("of some of the points"));
    }
    let places = places.ok_or_else(|| call.fault(&format!("an index beyond an axis of {length}")))?;
    let reshaped = |shape: &[usize], axis: usize| {
        let mut shape = shape.to_vec();
        shape.splice(axis..=axis, indices.shape.iter().copied());
        shape
    };
    one(match kept(call, &value, axis, &places)? {
        Value::Varying(v) => Value::Varying(Varying { shape: reshaped(&v.shape, axis - leading), ..v }),
        Value::Constant(c) => {
            let shape = reshaped(&c.shape, axis);
            Value::Constant(Rc::new(Tensor { shape, ..Rc::unwrap_or_clone(c) }))
        }
        over => over,
    })
}

pub(super) fn split(call: &mut Call<'_, '_>) -> Result<Vec<Value>, FieldError> {
    let value = call.argument(0)?;
    let lengths = axes(call, &value)?;
    let axis = axis(call, Some(0), lengths.len())?;
    let length = lengths[axis].ok_or_else(|| call.refused("of some of the points"))?;
    if let Value::Varying(varying) = &value {
        own_axis(call, varying, axis)?;
    }
    call.budget.numbers(usize::try_from(length).unwrap_or(usize::MAX))?;
    let parts = call.node.outputs.len() as u64;
    let sizes = match call.list("split", 1)? {
        Some(sizes) => sizes,
        None => {
            let size = length.div_ceil(parts.max(1));
            (0..parts).map(|i| size.min(length.saturating_sub(i * size)) as i64).collect()
        }
    };
    let mut left = length;
    let mut results = Vec::with_capacity(sizes.len());
    for size in sizes {
        let start = length - left;
        let rest = u64::try_from(size).ok().and_then(|size| left.checked_sub(size));
        left = rest.ok_or_else(|| call.fault(&format!("pieces larger than an axis of {length}")))?;
        let places: Vec<usize> = (start as usize..(length - left) as usize).collect();
        results.push(kept(call, &value, axis, &places)?);
    }
    Ok(results)
}
