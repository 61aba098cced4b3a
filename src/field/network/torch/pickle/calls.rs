//! Opcodes that in Python would import, call or construct something, and what comes of them here.

use super::super::MAX_TENSORS;
use super::super::globals::Global;
use super::super::rebuild::{Record, Storage, View};
use super::{Container, MAX_AXES, MAX_GLOBAL, MAX_KEY, Machine, Value, limit};
use crate::field::FieldError;

impl<'a> Machine<'a> {
    /// Opcodes that name globals, call them, or give objects their state.
    pub(super) fn object(&mut self, opcode: u8) -> Result<(), FieldError> {
        let made = match opcode {
            b'c' | b'i' => {
                let (module, name) = (self.line(MAX_GLOBAL)?, self.line(MAX_GLOBAL)?);
                let global = self.global(Self::text_of(module), Self::text_of(name))?;
                if opcode == b'i' {
                    let arguments = self.pop_mark()?;
                    self.call(global, &arguments)?
                } else {
                    global
                }
            }
            0x93 => {
                let (name, module) = (self.pop()?, self.pop()?);
                self.global(module, name)?
            }
            b'o' => {
                let members = self.pop_mark()?;
                let (class, arguments) =
                    members.split_first().ok_or_else(|| self.fault("an object is made of no class"))?;
                self.call(*class, arguments)?
            }
            b'R' | 0x81 => {
                let (arguments, callable) = (self.pop()?, self.pop()?);
                self.call_with(callable, arguments)?
            }
            0x92 => {
                let (_named, arguments, class) = (self.pop()?, self.pop()?, self.pop()?);
                self.call_with(class, arguments)?
            }
            // state is what attributes hold (the `_metadata` of a dictionary, the options of a namespace): never weights
            b'b' => {
                self.pop()?;
                return self.top().map(|_| ());
            }
            _ => {
                let name = self.pop()?;
                self.persistent(name)?
            }
        };
        self.push(made)
    }

    fn global(&self, module: Value<'a>, name: Value<'a>) -> Result<Value<'a>, FieldError> {
        let (Value::Text(module), Value::Text(name)) = (module, name) else {
            return Err(self.fault("the name of a global is not text"));
        };
        if module.len() > MAX_GLOBAL || name.len() > MAX_GLOBAL {
            return Err(limit("bytes of the name of a global", module.len().max(name.len()) as u64, MAX_GLOBAL as u64));
        }
        Global::find(module, name).map(Value::Global).ok_or_else(|| {
            let global = format!("{module}.{name}");
            FieldError::Unsupported {
                detail: format!(
                    "the global {global:?} in the {} at byte {}; a checkpoint may only hold tensors and plain values, and \
                     nothing of this one was run: save the state_dict of the network instead",
                    self.place, self.opcode_at
                ),
            }
        })
    }

    fn call_with(&mut self, callable: Value<'a>, arguments: Value<'a>) -> Result<Value<'a>, FieldError> {
        let fault = || self.fault("a call has arguments that are no tuple");
        let Value::Container(index) = arguments else { return Err(fault()) };
        let Container::Tuple(members) = &self.made.containers[index] else { return Err(fault()) };
        // no call that is known looks at more arguments than a tensor has
        let first: Vec<_> = members.iter().take(8).copied().collect();
        self.call(callable, &first)
    }

    /// What a call gives, as far as tensors are concerned.
    fn call(&mut self, callable: Value<'a>, arguments: &[Value<'a>]) -> Result<Value<'a>, FieldError> {
        let Value::Global(global) = callable else {
            return Err(self.fault("something is called that is no global"));
        };
        match global {
            Global::Dictionary => self.dictionary(arguments),
            Global::Sequence => Ok(match arguments.first() {
                Some(value) if self.made.sequence(*value).is_some() => *value,
                _ => Value::Opaque,
            }),
            Global::RebuildTensor => self.tensor(arguments),
            Global::RebuildParameter => match arguments.first() {
                Some(tensor @ Value::Tensor(_)) => Ok(*tensor),
                _ => Err(self.fault("a parameter is made of something that is no tensor")),
            },
            Global::RebuildFromType => match arguments {
                [Value::Global(Global::RebuildFromType), ..] => Err(self.fault("a tensor is made of itself")),
                [inner @ Value::Global(_), _, arguments, ..] => self.call_with(*inner, *arguments),
                _ => Err(self.fault("a tensor is made of something that is no call")),
            },
            Global::Storage(_) => Err(self.unsupported("a storage inside the pickle")),
            Global::Holder => Ok(Value::Opaque),
        }
    }

    /// A new dictionary from the last argument: another dictionary, or pairs as Python 2 writes them.
    fn dictionary(&mut self, arguments: &[Value<'a>]) -> Result<Value<'a>, FieldError> {
        let Some(Value::Container(index)) = arguments.last().copied() else {
            return Ok(self.made_container(Container::Dictionary(Vec::new())));
        };
        let count = match &self.made.containers[index] {
            Container::List(members) | Container::Tuple(members) => members.len(),
            Container::Dictionary(pairs) => pairs.len(),
        };
        self.charge(count)?;
        let pairs = match &self.made.containers[index] {
            Container::Dictionary(pairs) => pairs.clone(),
            Container::List(members) | Container::Tuple(members) => {
                let pair = |member: &Value<'a>| match self.made.sequence(*member) {
                    Some([key, value]) => Ok((*key, *value)),
                    _ => Err(self.fault("a dictionary is made of something that is no pair")),
                };
                members.iter().map(pair).collect::<Result<_, _>>()?
            }
        };
        Ok(self.made_container(Container::Dictionary(pairs)))
    }

    /// Whole numbers that cannot be negative, such as a shape.
    fn sizes(&self, value: Value<'a>) -> Result<Vec<usize>, FieldError> {
        let members = self.made.sequence(value).ok_or_else(|| self.fault("a shape or stride is no tuple"))?;
        if members.len() > MAX_AXES {
            return Err(limit("axes of a tensor", members.len() as u64, MAX_AXES as u64));
        }
        let size = |member: &Value<'a>| self.size(*member);
        members.iter().map(size).collect()
    }

    fn size(&self, value: Value<'a>) -> Result<usize, FieldError> {
        let Value::Int(number) = value else { return Err(self.fault("a size is no whole number")) };
        usize::try_from(number).map_err(|_| self.fault(format!("a size, an offset or a stride is {number}")))
    }

    fn tensor(&mut self, arguments: &[Value<'a>]) -> Result<Value<'a>, FieldError> {
        let &[Value::Storage(view), offset, shape, strides, ref rest @ ..] = arguments else {
            return Err(self.fault("a tensor is made of something else than storage, offset, shape and strides"));
        };
        // after (requires_grad, backward_hooks) come the bits that say that the numbers are to be negated or conjugated
        if let Some(Value::Container(index)) = rest.get(2)
            && !matches!(&self.made.containers[*index], Container::Dictionary(bits) if bits.is_empty())
        {
            return Err(self.unsupported("a tensor with bits of negation or conjugation"));
        }
        let record = Record {
            view,
            offset: self.size(offset)?,
            shape: self.sizes(shape)?,
            strides: self.sizes(strides)?,
            at: self.opcode_at,
        };
        if record.shape.len() != record.strides.len() {
            return Err(self.fault(format!(
                "a tensor of {} axes has {} strides",
                record.shape.len(),
                record.strides.len()
            )));
        }
        if self.made.tensors.len() == MAX_TENSORS {
            return Err(limit("tensors of a checkpoint", MAX_TENSORS as u64 + 1, MAX_TENSORS as u64));
        }
        self.made.tensors.push(record);
        Ok(Value::Tensor(self.made.tensors.len() - 1))
    }

    /// What is kept outside the pickle: `("storage", type, key, location, count)`, and in streams a view as well.
    fn persistent(&mut self, name: Value<'a>) -> Result<Value<'a>, FieldError> {
        let &[Value::Text("storage"), Value::Global(Global::Storage(kind)), Value::Text(key), _, count, ref rest @ ..] =
            self.made.sequence(name).unwrap_or_default()
        else {
            return Err(self.fault("a persistent name is not that of a storage of numbers"));
        };
        if key.len() > MAX_KEY {
            return Err(limit("bytes of the key of a storage", key.len() as u64, MAX_KEY as u64));
        }
        let count = self.size(count)?;
        let (offset, view_count) = match rest {
            [] | [Value::None, ..] => (0, count),
            [view, ..] => match self.made.sequence(*view) {
                Some([_, offset, view_count, ..]) => (self.size(*offset)?, self.size(*view_count)?),
                _ => return Err(self.fault("the view of a storage is no tuple of key, offset and size")),
            },
        };
        if offset.checked_add(view_count).is_none_or(|end| end > count) {
            return Err(self.fault(format!("a view reaches past the {count} numbers of the storage {key:?}")));
        }
        let storage = *self.storage_of_key.entry(key).or_insert(self.made.storages.len());
        if storage == self.made.storages.len() {
            self.made.storages.push(Storage { key, kind, count });
        }
        let known = &self.made.storages[storage];
        if (known.kind, known.count) != (kind, count) {
            return Err(self.fault(format!("the storage {key:?} is of two types or sizes")));
        }
        self.made.views.push(View { storage, offset, count: view_count });
        Ok(Value::Storage(self.made.views.len() - 1))
    }
}
