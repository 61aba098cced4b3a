//! Which operator does what, and what they have in common: their arguments, attributes and refusals.

use super::budget::Budget;
use super::model::{Attribute, Node, is_standard};
use super::stages::Stages;
use super::tensor::Tensor;
use super::value::Value;
use super::{arithmetic, axes, fault, structure};
use crate::field::FieldError;
use std::rc::Rc;

/// A node with its arguments.
pub(super) struct Call<'c, 'a> {
    pub node: &'c Node<'a>,
    /// `None` for one that is left out.
    pub arguments: Vec<Option<Value>>,
    pub budget: &'c mut Budget,
    pub stages: &'c mut Stages,
}

/// The node's outputs.
pub(super) fn apply(call: &mut Call<'_, '_>) -> Result<Vec<Value>, FieldError> {
    if !is_standard(call.node.domain) {
        return Err(call.refused(""));
    }
    match call.node.operator {
        "Add" | "Sub" | "Mul" | "Div" | "Pow" | "Max" | "Min" | "Equal" | "Greater" | "GreaterOrEqual" | "Less" => {
            arithmetic::binary(call)
        }
        "Relu" | "Tanh" | "Sigmoid" | "Elu" | "Softplus" | "Sin" | "Cos" => arithmetic::activation(call),
        "Neg" | "Sqrt" | "Exp" | "Log" | "Abs" | "Reciprocal" => arithmetic::unary(call),
        "Clip" => arithmetic::clip(call),
        "Where" => arithmetic::choice(call),
        "MatMul" => arithmetic::matmul(call),
        "Gemm" => arithmetic::gemm(call),
        "ReduceSum" | "ReduceMean" | "ReduceL2" | "ReduceSumSquare" => arithmetic::reduce(call),
        "Identity" | "Dropout" | "Cast" | "CastLike" => structure::same(call),
        "Constant" => structure::constant(call),
        "ConstantOfShape" => structure::constant_of_shape(call),
        "Range" => structure::range(call),
        "Shape" => structure::shape(call),
        "Concat" => structure::concat(call),
        "Slice" => structure::slice(call),
        "Gather" => structure::gather(call),
        "Split" => structure::split(call),
        "Transpose" => axes::transpose(call),
        "Reshape" => axes::reshape(call),
        "Flatten" => axes::flatten(call),
        "Squeeze" => axes::squeeze(call),
        "Unsqueeze" => axes::unsqueeze(call),
        "Expand" => axes::expand(call),
        "Tile" => axes::tile(call),
        _ => Err(call.refused("")),
    }
}

impl Call<'_, '_> {
    /// The node is not read: all of it where `why` is empty, or for a reason.
    pub(super) fn refused(&self, why: &str) -> FieldError {
        let title = self.node.title();
        let detail = if why.is_empty() { title } else { format!("{title}: {why}") };
        FieldError::Unsupported { detail }
    }

    /// The node breaks the rules of its operator.
    pub(super) fn fault(&self, what: &str) -> FieldError {
        fault(Some(self.node.at), format!("{}: {what}", self.node.title()))
    }

    pub(super) fn argument(&self, at: usize) -> Result<Value, FieldError> {
        self.optional(at).ok_or_else(|| self.fault(&format!("input {at} is missing")))
    }

    pub(super) fn optional(&self, at: usize) -> Option<Value> {
        self.arguments.get(at).cloned().flatten()
    }

    /// An argument that must be constant.
    pub(super) fn tensor(&self, at: usize) -> Result<Rc<Tensor>, FieldError> {
        match self.argument(at)? {
            Value::Constant(tensor) => Ok(tensor),
            _ => Err(self.refused(&format!("input {at} that is not constant"))),
        }
    }

    /// Whole numbers that are all known.
    pub(super) fn whole(&self, numbers: &[f64]) -> Result<Vec<i64>, FieldError> {
        let known = |&v: &f64| if v.is_nan() { None } else { Some(v as i64) };
        let known: Option<Vec<i64>> = numbers.iter().map(known).collect();
        known.ok_or_else(|| self.refused("a number that depends on how many points there are"))
    }

    /// A list of whole numbers that newer versions of an operator take as an input and older ones as an attribute.
    pub(super) fn list(&self, name: &str, at: usize) -> Result<Option<Vec<i64>>, FieldError> {
        if let Some(list) = self.ints(name)? {
            return Ok(Some(list.to_vec()));
        }
        if self.optional(at).is_none() {
            return Ok(None);
        }
        Ok(Some(self.whole(&self.tensor(at)?.numbers)?))
    }

    fn attribute(&self, name: &str) -> Option<&Attribute<'_>> {
        self.node.attributes.iter().find(|(n, _)| *n == name).map(|(_, value)| value)
    }

    pub(super) fn int(&self, name: &str, default: i64) -> Result<i64, FieldError> {
        match self.attribute(name) {
            None => Ok(default),
            Some(Attribute::Int(value)) => Ok(*value),
            Some(_) => Err(self.fault(&format!("the attribute {name} is not a whole number"))),
        }
    }

    pub(super) fn float(&self, name: &str, default: f32) -> Result<f64, FieldError> {
        match self.attribute(name) {
            None => Ok(f64::from(default)),
            Some(Attribute::Float(value)) if value.is_finite() => Ok(f64::from(*value)),
            Some(_) => Err(self.fault(&format!("the attribute {name} is not a finite number"))),
        }
    }

    pub(super) fn ints(&self, name: &str) -> Result<Option<&[i64]>, FieldError> {
        match self.attribute(name) {
            None => Ok(None),
            Some(Attribute::Ints(list)) => Ok(Some(list)),
            Some(_) => Err(self.fault(&format!("the attribute {name} is not a list of whole numbers"))),
        }
    }

    /// The tensor that an attribute holds, whichever of the forms of a `Constant` it has.
    pub(super) fn held(&mut self, name: &str) -> Result<Option<Tensor>, FieldError> {
        let tensor = match self.attribute(name) {
            None => return Ok(None),
            Some(Attribute::Tensor(raw)) => {
                let (count, decoded) = (raw.count()?, raw.decode());
                self.budget.numbers(count)?;
                return decoded.map(Some);
            }
            Some(Attribute::Int(value)) => Tensor::whole(Vec::new(), vec![*value as f64]),
            Some(Attribute::Ints(list)) => Tensor::whole(vec![list.len()], list.iter().map(|&v| v as f64).collect()),
            Some(Attribute::Float(value)) => {
                Tensor { shape: Vec::new(), integer: false, numbers: vec![f64::from(*value)] }
            }
            Some(Attribute::Floats(list)) => {
                let numbers = list.iter().map(|&v| f64::from(v)).collect();
                Tensor { shape: vec![list.len()], integer: false, numbers }
            }
            Some(Attribute::Other) => return Err(self.refused(&format!("the attribute {name}"))),
        };
        if tensor.numbers.iter().any(|v| !v.is_finite()) {
            return Err(self.fault(&format!("the attribute {name} is not finite")));
        }
        Ok(Some(tensor))
    }
}

/// The one output of a node.
pub(super) fn one(value: Value) -> Result<Vec<Value>, FieldError> {
    Ok(vec![value])
}

/// The one output of a node, a constant.
pub(super) fn known(tensor: Tensor) -> Result<Vec<Value>, FieldError> {
    one(Value::Constant(Rc::new(tensor)))
}
