//! Works a graph through, node by node in the order of the file, which ONNX wants to be an order of computation.

use super::budget::Budget;
use super::forms::Forms;
use super::model::{Model, ValueInfo};
use super::operators::{self, Call};
use super::stages::Stages;
use super::value::{Value, Varying};
use super::{fault, quoted};
use crate::field::FieldError;
use crate::field::network::{MAX_LATENT, Network};
use std::collections::HashMap;
use std::collections::hash_map::Entry;
use std::rc::Rc;

/// Coordinates of a point.
const AXES: usize = 3;

/// The network that a model of so many bytes computes.
pub(super) fn network(model: &Model<'_>, bytes: usize) -> Result<Network, FieldError> {
    let mut budget = Budget::new(bytes);
    let mut uses = unique_names(model)?;
    let output = match model.outputs.as_slice() {
        [output] => output.name,
        [] => return Err(fault(None, "a graph without an output".to_owned())),
        [first, second, ..] => {
            let detail =
                format!("an ONNX model with several outputs, {} and {}", quoted(first.name), quoted(second.name));
            return Err(FieldError::Unsupported { detail });
        }
    };
    let needed = needed(model, output, &mut uses);
    let (mut values, inputs) = inputs(model)?;
    let mut stages = Stages::new(inputs);
    let tensors: HashMap<&str, usize> = model.tensors.iter().enumerate().map(|(i, t)| (t.name, i)).collect();
    for node in model.nodes.iter().zip(needed).filter_map(|(node, needed)| needed.then_some(node)) {
        let mut arguments = Vec::with_capacity(node.inputs.len());
        for &name in &node.inputs {
            if name.is_empty() {
                arguments.push(None);
                continue;
            }
            if !values.contains_key(name) {
                let Some(&tensor) = tensors.get(name) else {
                    let detail = format!("{} takes {}, which nothing before it gives", node.title(), quoted(name));
                    return Err(fault(Some(node.at), detail));
                };
                budget.numbers(model.tensors[tensor].count()?)?;
                values.insert(name, Value::Constant(Rc::new(model.tensors[tensor].decode()?)));
            }
            // what nobody takes any more is not kept
            let left = uses.get_mut(name).map(|left| {
                *left -= 1;
                *left
            });
            arguments.push(if left == Some(0) { values.remove(name) } else { values.get(name).cloned() });
        }
        let mut call = Call { node, arguments, budget: &mut budget, stages: &mut stages };
        let results = operators::apply(&mut call)?;
        for (&name, value) in node.outputs.iter().zip(results) {
            if uses.get(name).is_some_and(|&left| left > 0) {
                values.insert(name, value);
            }
        }
    }
    let forms = match values.remove(output) {
        Some(Value::Varying(varying)) => varying.forms,
        Some(_) => return Err(fault(None, format!("the output {} does not depend on the point", quoted(output)))),
        None => return Err(fault(None, format!("nothing gives the output {}", quoted(output)))),
    };
    if forms.len() != 1 {
        let detail = format!("the ONNX output {} of {} numbers for a point, not one", quoted(output), forms.len());
        return Err(FieldError::Unsupported { detail });
    }
    if forms.is_constant() {
        return Err(fault(None, format!("the output {} does not depend on the point", quoted(output))));
    }
    stages.network(&forms, inputs - AXES, &mut budget)
}

/// Checks that nothing has the name of something else. Gives all names, each with no use.
fn unique_names<'a>(model: &Model<'a>) -> Result<HashMap<&'a str, usize>, FieldError> {
    let mut names = HashMap::new();
    let twice = |name: &str, at| Err(fault(at, format!("the name {} is given twice", quoted(name))));
    for tensor in &model.tensors {
        if names.insert(tensor.name, 0).is_some() {
            return twice(tensor.name, Some(tensor.body.offset()));
        }
    }
    // an input with the name of a tensor has it as its default
    let initialized = names.clone();
    for input in &model.inputs {
        if names.insert(input.name, 0).is_some() && !initialized.contains_key(input.name) {
            return twice(input.name, None);
        }
    }
    for node in &model.nodes {
        for name in node.outputs.iter().filter(|name| !name.is_empty()) {
            if names.insert(name, 0).is_some() {
                return twice(name, Some(node.at));
            }
        }
    }
    Ok(names)
}

/// Which nodes the output needs; counts who takes what among them.
fn needed<'a>(model: &Model<'a>, output: &'a str, uses: &mut HashMap<&'a str, usize>) -> Vec<bool> {
    *uses.entry(output).or_insert(0) += 1;
    let mut needed = vec![false; model.nodes.len()];
    for (node, needed) in model.nodes.iter().zip(&mut needed).rev() {
        *needed = node.outputs.iter().any(|name| !name.is_empty() && uses.get(name).is_some_and(|&uses| uses > 0));
        if *needed {
            for name in node.inputs.iter().filter(|name| !name.is_empty()) {
                match uses.entry(name) {
                    Entry::Occupied(mut entry) => *entry.get_mut() += 1,
                    Entry::Vacant(entry) => drop(entry.insert(1)),
                }
            }
        }
    }
    needed
}

/// The inputs as forms, and how many numbers they have together. The latent code comes before the point.
fn inputs<'a>(model: &Model<'a>) -> Result<(HashMap<&'a str, Value>, usize), FieldError> {
    let initialized: std::collections::HashSet<&str> = model.tensors.iter().map(|t| t.name).collect();
    let given: Vec<&ValueInfo<'a>> = model.inputs.iter().filter(|i| !initialized.contains(i.name)).collect();
    let unsupported = |detail: String| FieldError::Unsupported { detail };
    let width = |input: &ValueInfo<'_>| match input.shape.as_deref() {
        Some([.., Some(columns)]) => Ok(*columns),
        _ => Err(unsupported(format!("the ONNX input {} without a declared number of columns", quoted(input.name)))),
    };
    let point_first = match given.as_slice() {
        [] => return Err(fault(None, "a graph without an input".to_owned())),
        [_] => true,
        [a, b] => match (width(a)?, width(b)?) {
            (3, 3) => {
                let (a, b) = (quoted(a.name), quoted(b.name));
                return Err(unsupported(format!(
                    "an ONNX model with two inputs of three columns, {a} and {b} (which is the point?)"
                )));
            }
            (3, _) => true,
            (_, 3) => false,
            _ => {
                return Err(unsupported("an ONNX model with two inputs of which none has three columns".to_owned()));
            }
        },
        [_, _, third, ..] => return Err(unsupported(format!("the third ONNX input {}", quoted(third.name)))),
    };
    let (mut values, mut start) = (HashMap::new(), 0);
    let mut order: Vec<&ValueInfo<'a>> = given;
    if point_first {
        order.reverse();
    }
    for input in order {
        let columns = width(input)?;
        let limit = (MAX_LATENT + AXES) as u64;
        if columns > limit {
            return Err(FieldError::Limit { what: "columns of an ONNX input", found: columns, limit });
        }
        let columns = columns as usize;
        let lead = input.shape.as_ref().map_or(Vec::new(), |shape| shape[..shape.len() - 1].to_vec());
        let forms = Rc::new(Forms::units(0, start..start + columns));
        values.insert(input.name, Value::Varying(Varying { lead, shape: vec![columns], forms }));
        start += columns;
    }
    if start < AXES {
        return Err(unsupported(format!("an ONNX model of points with {start} coordinates")));
    }
    Ok((values, start))
}
