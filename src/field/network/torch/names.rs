//! Names of the tensors in nested dictionaries, lists and tuples: keys and indices joined by dots.
//!
//! A pickle may share a container among many and may even put one into itself, so what would be a walk over a tree is one
//! over paths: their number, their length and the length of a name are limited.

use super::pickle::{Container, Loaded, Value};
use super::{FORMAT, MAX_TENSORS};
use crate::field::FieldError;
use std::collections::{BTreeMap, HashSet};

/// Most containers in containers, which is more than any training script nests and little for the stack of a thread.
const MAX_DEPTH: usize = 64;
/// Most values that are looked at: a container counts as often as a path leads to it.
const MAX_VALUES: u64 = 1 << 20;
/// Most bytes of a name.
const MAX_NAME: usize = 1024;

/// The tensors of a checkpoint with their names, in the order of the names.
pub(super) fn of(loaded: &Loaded<'_>) -> Result<Vec<(String, usize)>, FieldError> {
    let mut walk = Walk { loaded, path: Vec::new(), name: String::new(), seen: 0, found: BTreeMap::new() };
    walk.value(loaded.root)?;
    Ok(walk.found.into_iter().collect())
}

struct Walk<'l, 'a> {
    loaded: &'l Loaded<'a>,
    /// Numbers of the containers that are open.
    path: Vec<usize>,
    name: String,
    seen: u64,
    found: BTreeMap<String, usize>,
}

fn fault(detail: String) -> FieldError {
    FieldError::Malformed { format: FORMAT, at: None, detail }
}

impl Walk<'_, '_> {
    fn value(&mut self, value: Value<'_>) -> Result<(), FieldError> {
        match value {
            Value::Tensor(tensor) => {
                if self.found.insert(self.name.clone(), tensor).is_some() {
                    return Err(fault(format!("two tensors have the name {:?}", self.name)));
                }
                if self.found.len() > MAX_TENSORS {
                    let (found, limit) = (self.found.len() as u64, MAX_TENSORS as u64);
                    return Err(FieldError::Limit { what: "tensors of a checkpoint", found, limit });
                }
                Ok(())
            }
            Value::Container(index) => {
                if self.path.contains(&index) {
                    return Err(fault(format!("the container {:?} holds itself", self.name)));
                }
                if self.path.len() == MAX_DEPTH {
                    let (found, limit) = (MAX_DEPTH as u64 + 1, MAX_DEPTH as u64);
                    return Err(FieldError::Limit { what: "containers in each other in a checkpoint", found, limit });
                }
                self.path.push(index);
                self.members(index)?;
                self.path.pop();
                Ok(())
            }
            _ => Ok(()),
        }
    }

    fn members(&mut self, index: usize) -> Result<(), FieldError> {
        let loaded = self.loaded;
        match &loaded.containers[index] {
            Container::List(members) | Container::Tuple(members) => {
                for (i, member) in members.iter().enumerate() {
                    self.member(*member, |_| i.to_string())?;
                }
            }
            Container::Dictionary(pairs) => {
                // of pairs with the same key the last one counts
                let (mut texts, mut numbers) = (HashSet::new(), HashSet::new());
                for (key, value) in pairs.iter().rev() {
                    match *key {
                        Value::Text(text) if texts.insert(text) => self.member(*value, |_| text.to_owned())?,
                        Value::Int(number) if numbers.insert(number) => self.member(*value, |_| number.to_string())?,
                        // keys of other types name nothing
                        _ => self.member(Value::None, |_| String::new())?,
                    }
                }
            }
        }
        Ok(())
    }

    fn member(&mut self, value: Value<'_>, key: impl Fn(()) -> String) -> Result<(), FieldError> {
        self.seen += 1;
        if self.seen > MAX_VALUES {
            return Err(FieldError::Limit { what: "values of a checkpoint", found: self.seen, limit: MAX_VALUES });
        }
        if !matches!(value, Value::Tensor(_) | Value::Container(_)) {
            return Ok(());
        }
        let parent = self.name.len();
        let key = key(());
        let length = parent + 1 + key.len();
        if length > MAX_NAME {
            let (found, limit) = (length as u64, MAX_NAME as u64);
            return Err(FieldError::Limit { what: "bytes of the name of a tensor", found, limit });
        }
        if self.path.len() > 1 {
            self.name.push('.');
        }
        self.name.push_str(&key);
        self.value(value)?;
        self.name.truncate(parent);
        Ok(())
    }
}
