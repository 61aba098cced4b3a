//! Names of the tensors in nested dictionaries, lists and tuples: keys and indices joined by dots.
//!
//! A pickle may share a container among many and may even put one into itself, so what would be a walk over a tree is one
//! over paths: their number, their length and the length of a name are limited.

use super::pickle::{Container, Loaded, Value};
use super::{FORMAT, MAX_TENSORS};
use crate::field::FieldError;
use std::borrow::Cow;
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

/// What a member is called in its container.
#[derive(Clone, Copy, PartialEq, Eq, Hash)]
enum Key<'a> {
    Text(&'a str),
    Number(i64),
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
                    self.member(*member, Key::Number(i as i64))?;
                }
            }
            Container::Dictionary(pairs) => {
                // of pairs with the same key the last one counts
                let mut seen = HashSet::new();
                for (key, value) in pairs.iter().rev() {
                    let key = match *key {
                        // never hashed: one long text may be the key of many pairs
                        Value::Text(text) if text.len() > MAX_NAME => Some(Key::Text(text)),
                        Value::Text(text) => Some(Key::Text(text)).filter(|key| seen.insert(*key)),
                        Value::Int(number) => Some(Key::Number(number)).filter(|key| seen.insert(*key)),
                        // keys of other types name nothing
                        _ => None,
                    };
                    match key {
                        Some(key) => self.member(*value, key)?,
                        None => self.look()?,
                    }
                }
            }
        }
        Ok(())
    }

    /// Counts a value that is looked at.
    fn look(&mut self) -> Result<(), FieldError> {
        self.seen += 1;
        if self.seen > MAX_VALUES {
            return Err(FieldError::Limit { what: "values of a checkpoint", found: self.seen, limit: MAX_VALUES });
        }
        Ok(())
    }

    fn member(&mut self, value: Value<'_>, key: Key<'_>) -> Result<(), FieldError> {
        self.look()?;
        if !matches!(value, Value::Tensor(_) | Value::Container(_)) {
            return Ok(());
        }
        let parent = self.name.len();
        let key = match key {
            Key::Text(text) => Cow::Borrowed(text),
            Key::Number(number) => Cow::Owned(number.to_string()),
        };
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
