//! The messages of an ONNX model that matter to a network: <https://github.com/onnx/onnx/blob/main/onnx/onnx.proto>.
//!
//! Numbers of tensors stay where they are in the file until they are needed ([`RawTensor::decode`](super::tensor)).

use super::wire::Message;
use super::{fault, quoted};
use crate::field::FieldError;

/// Most nodes, initializers, inputs and outputs of a graph, each.
const MAX_ITEMS: usize = 65_536;
/// Most inputs and most outputs of a node; a list of pieces to join is the only long one.
const MAX_NAMES: usize = 4096;
/// Most attributes of a node; no operator has half as many.
const MAX_ATTRIBUTES: usize = 64;
/// Most axes of a tensor.
pub(super) const MAX_AXES: usize = 8;
/// Most numbers of a list in an attribute.
const MAX_LIST: usize = 1 << 20;
/// The first version of the operators whose broadcasting is the one of today.
const OLDEST_OPSET: i64 = 7;

/// A model: its graph, and by which version of the operators it is to be understood.
#[derive(Debug, Default)]
pub(super) struct Model<'a> {
    /// Version of the standard operators.
    pub opset: i64,
    /// In the order of the file, which is an order of computation.
    pub nodes: Vec<Node<'a>>,
    /// Constants by name.
    pub tensors: Vec<RawTensor<'a>>,
    /// What is given to the graph.
    pub inputs: Vec<ValueInfo<'a>>,
    /// What the graph gives.
    pub outputs: Vec<ValueInfo<'a>>,
}

/// One operation.
#[derive(Debug, Default)]
pub(super) struct Node<'a> {
    pub operator: &'a str,
    /// Whose operator it is; empty for ONNX's own.
    pub domain: &'a str,
    pub name: &'a str,
    /// An optional input that is left out has an empty name.
    pub inputs: Vec<&'a str>,
    pub outputs: Vec<&'a str>,
    pub attributes: Vec<(&'a str, Attribute<'a>)>,
    /// Offset in the file.
    pub at: u64,
}

/// The value of an attribute.
#[derive(Debug)]
pub(super) enum Attribute<'a> {
    Float(f32),
    Int(i64),
    Tensor(RawTensor<'a>),
    Floats(Vec<f32>),
    Ints(Vec<i64>),
    /// Text, graphs and whatever else no operator that is read looks at.
    Other,
}

/// A tensor whose numbers were not read yet.
#[derive(Clone, Debug)]
pub(super) struct RawTensor<'a> {
    pub name: &'a str,
    pub dims: Vec<i64>,
    /// Number of the element type.
    pub kind: i64,
    /// Whether the numbers are in another file.
    pub external: bool,
    /// The whole message.
    pub body: Message<'a>,
}

/// Name and declared shape of an input or an output.
#[derive(Debug)]
pub(super) struct ValueInfo<'a> {
    pub name: &'a str,
    /// Lengths of the axes, `None` for one that is free; `None` where no shape is declared.
    pub shape: Option<Vec<Option<u64>>>,
}

/// Adds to a list that may hold so many.
fn push<T>(list: &mut Vec<T>, item: T, what: &'static str, most: usize) -> Result<(), FieldError> {
    if list.len() == most {
        return Err(FieldError::Limit { what, found: most as u64 + 1, limit: most as u64 });
    }
    list.push(item);
    Ok(())
}

impl<'a> Model<'a> {
    /// Reads the messages of a model.
    pub(super) fn parse(bytes: &'a [u8]) -> Result<Self, FieldError> {
        let mut model = Self::default();
        let mut message = Message::new(bytes);
        let mut graph = None;
        while let Some(field) = message.next()? {
            match field.number {
                7 if graph.is_some() => return Err(fault(Some(field.at), "a second graph".to_owned())),
                7 => graph = Some(field.message()?),
                8 => {
                    let (mut opset, mut domain, mut version) = (field.message()?, "", 1);
                    while let Some(field) = opset.next()? {
                        match field.number {
                            1 => domain = field.text()?,
                            2 => version = field.int()?,
                            _ => {}
                        }
                    }
                    if is_standard(domain) {
                        model.opset = version;
                    }
                }
                25 => {
                    let (mut function, mut name) = (field.message()?, "");
                    while let Some(field) = function.next()? {
                        if field.number == 1 {
                            name = field.text()?;
                        }
                    }
                    let detail = format!("the ONNX model's own function {}", quoted(name));
                    return Err(FieldError::Unsupported { detail });
                }
                _ => {}
            }
        }
        let Some(graph) = graph else {
            return Err(fault(Some(message.offset()), "a model without a graph".to_owned()));
        };
        if model.opset < OLDEST_OPSET {
            let found = model.opset;
            let detail = format!("version {found} of the ONNX operators (read are those from {OLDEST_OPSET} on)");
            return Err(FieldError::Unsupported { detail });
        }
        model.graph(graph)?;
        Ok(model)
    }

    fn graph(&mut self, mut graph: Message<'a>) -> Result<(), FieldError> {
        while let Some(field) = graph.next()? {
            match field.number {
                1 => push(&mut self.nodes, Node::parse(field.message()?)?, "nodes of an ONNX graph", MAX_ITEMS)?,
                5 => {
                    let tensor = RawTensor::parse(field.message()?)?;
                    push(&mut self.tensors, tensor, "initializers of an ONNX graph", MAX_ITEMS)?;
                }
                11 => push(&mut self.inputs, value_info(field.message()?)?, "inputs of an ONNX graph", MAX_ITEMS)?,
                12 => push(&mut self.outputs, value_info(field.message()?)?, "outputs of an ONNX graph", MAX_ITEMS)?,
                _ => {}
            }
        }
        Ok(())
    }
}

/// Whether a domain of operators is ONNX's own.
pub(super) fn is_standard(domain: &str) -> bool {
    domain.is_empty() || domain == "ai.onnx"
}

impl<'a> Node<'a> {
    fn parse(mut message: Message<'a>) -> Result<Self, FieldError> {
        let mut node = Self { at: message.offset(), ..Self::default() };
        while let Some(field) = message.next()? {
            match field.number {
                1 => push(&mut node.inputs, field.text()?, "inputs of an ONNX node", MAX_NAMES)?,
                2 => push(&mut node.outputs, field.text()?, "outputs of an ONNX node", MAX_NAMES)?,
                3 => node.name = field.text()?,
                4 => node.operator = field.text()?,
                5 => {
                    let attribute = attribute(field.message()?)?;
                    push(&mut node.attributes, attribute, "attributes of an ONNX node", MAX_ATTRIBUTES)?;
                }
                7 => node.domain = field.text()?,
                _ => {}
            }
        }
        Ok(node)
    }

    /// The node for a message: its name, or where it has none that of its first output, and its operator.
    pub(super) fn title(&self) -> String {
        let operator = if is_standard(self.domain) {
            quoted(self.operator)
        } else {
            quoted(&format!("{}::{}", self.domain, self.operator))
        };
        let operator = operator.replace('"', "");
        match self.outputs.first() {
            Some(output) if self.name.is_empty() => format!("the ONNX node {operator} that gives {}", quoted(output)),
            _ => format!("the ONNX node {operator} named {}", quoted(self.name)),
        }
    }
}

fn attribute<'a>(mut message: Message<'a>) -> Result<(&'a str, Attribute<'a>), FieldError> {
    let (mut name, mut kind) = ("", 0);
    let mut value = None;
    let (mut ints, mut floats) = (Vec::new(), Vec::new());
    while let Some(field) = message.next()? {
        match field.number {
            1 => name = field.text()?,
            2 => value = Some(Attribute::Float(field.float()?)),
            3 => value = Some(Attribute::Int(field.int()?)),
            5 => value = Some(Attribute::Tensor(RawTensor::parse(field.message()?)?)),
            7 => field.fixed::<4>(&mut floats, MAX_LIST)?,
            8 => field.ints(&mut ints, MAX_LIST)?,
            20 => kind = field.int()?,
            _ => {}
        }
    }
    // a writer may leave out what is zero or empty; the type says what was meant
    let value = match (kind, value) {
        (7, _) => Attribute::Ints(ints),
        (6, _) => Attribute::Floats(floats.into_iter().map(f32::from_le_bytes).collect()),
        (2, None) => Attribute::Int(0),
        (1, None) => Attribute::Float(0.0),
        (_, Some(value)) => value,
        (_, None) if !ints.is_empty() => Attribute::Ints(ints),
        (_, None) => Attribute::Other,
    };
    Ok((name, value))
}

impl<'a> RawTensor<'a> {
    fn parse(body: Message<'a>) -> Result<Self, FieldError> {
        let mut tensor = Self { name: "", dims: Vec::new(), kind: 0, external: false, body };
        let mut message = body;
        while let Some(field) = message.next()? {
            match field.number {
                1 => field.ints(&mut tensor.dims, MAX_AXES)?,
                2 => tensor.kind = field.int()?,
                8 => tensor.name = field.text()?,
                13 => tensor.external = true,
                14 => tensor.external |= field.int()? == 1,
                _ => {}
            }
        }
        Ok(tensor)
    }
}

fn value_info<'a>(mut message: Message<'a>) -> Result<ValueInfo<'a>, FieldError> {
    let mut info = ValueInfo { name: "", shape: None };
    while let Some(field) = message.next()? {
        match field.number {
            1 => info.name = field.text()?,
            2 => {
                let mut kind = field.message()?;
                while let Some(field) = kind.next()? {
                    // a tensor; sequences, maps and optional values have other numbers and no shape
                    if field.number == 1 {
                        info.shape = tensor_shape(field.message()?)?;
                    }
                }
            }
            _ => {}
        }
    }
    Ok(info)
}

fn tensor_shape(mut tensor: Message<'_>) -> Result<Option<Vec<Option<u64>>>, FieldError> {
    let mut shape = None;
    while let Some(field) = tensor.next()? {
        if field.number != 2 {
            continue;
        }
        let (mut message, mut axes) = (field.message()?, Vec::new());
        while let Some(field) = message.next()? {
            if field.number != 1 {
                continue;
            }
            let (mut axis, mut length) = (field.message()?, None);
            while let Some(field) = axis.next()? {
                if field.number == 1 {
                    // some exporters write -1 or 0 for a free axis
                    length = u64::try_from(field.int()?).ok().filter(|&length| length > 0);
                }
            }
            push(&mut axes, length, "axes of an ONNX input", MAX_AXES)?;
        }
        shape = Some(axes);
    }
    Ok(shape)
}
