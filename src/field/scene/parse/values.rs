//! The values of members: numbers, lengths, vectors, polygons, each checked and each fault named at its place.

use super::super::polygon::{Defect, defect};
use super::{Dimension, LARGEST, MAX_POINTS, MAX_POLYGON, Members, Parser, SMALLEST};
use crate::field::type_name;
use serde_json::Value;

impl Parser {
    pub(super) fn axis_name(&mut self, value: &Value, own: Option<Dimension>) -> Option<usize> {
        let names = &["x", "y", "z"][..own.map_or(3, Dimension::length)];
        let found = value.as_str().and_then(|s| names.iter().position(|n| *n == s));
        if found.is_none() {
            let code = if value.is_string() { "out_of_range" } else { "wrong_type" };
            self.fault(code, format!("the axis is one of {names:?}"));
        }
        found
    }

    pub(super) fn counts(&mut self, m: Members<'_>, own: Option<Dimension>) -> Option<[u32; 3]> {
        self.at("count", |p| {
            let list = p.list(&m["count"], own)?;
            let mut counts = [1; 3];
            let mut whole = true;
            for (i, value) in list.iter().enumerate() {
                match value.as_u64() {
                    Some(n) if (1..=LARGEST as u64).contains(&n) => counts[i] = n as u32,
                    _ => {
                        whole = false;
                        let code = if value.is_number() { "out_of_range" } else { "wrong_type" };
                        p.item(i, |p| p.fault(code, format!("a count is a whole number from 1 to {LARGEST}")));
                    }
                }
            }
            whole.then_some(counts)
        })
    }

    pub(super) fn number(&mut self, value: &Value) -> Option<f64> {
        let Some(number) = value.as_f64() else {
            self.fault("wrong_type", format!("this is a number, and here is {}", type_name(value)));
            return None;
        };
        if !number.is_finite() {
            self.fault("not_finite", "the number is not finite");
            return None;
        }
        if number.abs() > LARGEST {
            self.fault("out_of_range", format!("{number:e} is beyond {LARGEST:e}"));
            return None;
        }
        Some(number)
    }

    pub(super) fn positive(&mut self, value: &Value) -> Option<f64> {
        let number = self.number(value)?;
        if number <= 0.0 {
            self.fault("not_positive", format!("{number} is not positive"));
            return None;
        }
        if number < SMALLEST {
            self.fault("out_of_range", format!("{number:e} is below {SMALLEST:e}"));
            return None;
        }
        Some(number)
    }

    pub(super) fn length(&mut self, m: Members<'_>, name: &str) -> Option<f64> {
        self.at(name, |p| p.positive(&m[name]))
    }

    pub(super) fn lengths<const N: usize>(&mut self, m: Members<'_>, name: &str) -> Option<[f64; N]> {
        self.at(name, |p| {
            let list = p.list(&m[name], Dimension::of_length(N))?;
            let values: Vec<_> = list.iter().enumerate().map(|(i, v)| p.item(i, |p| p.positive(v))).collect();
            values.into_iter().collect::<Option<Vec<f64>>>()?.try_into().ok()
        })
    }

    /// A list of as many values as the dimension has, or of two or three where it is not known.
    pub(super) fn list<'v>(&mut self, value: &'v Value, dimension: Option<Dimension>) -> Option<&'v [Value]> {
        let Some(list) = value.as_array() else {
            self.fault("wrong_type", format!("this is a list of numbers, and here is {}", type_name(value)));
            return None;
        };
        let (fits, wanted) = match dimension {
            None => (Dimension::of_length(list.len()).is_some(), "2 or 3".to_owned()),
            Some(d) => (list.len() == d.length(), d.length().to_string()),
        };
        if !fits {
            self.fault("wrong_length", format!("{wanted} components are needed, and here are {}", list.len()));
            return None;
        }
        Some(list)
    }

    /// A vector with its dimension; the third component of a planar one is 0.
    pub(super) fn vector(&mut self, value: &Value, dimension: Option<Dimension>) -> Option<([f64; 3], Dimension)> {
        let list = self.list(value, dimension)?;
        let (mut vector, mut whole) = ([0.0; 3], true);
        for (i, value) in list.iter().enumerate() {
            match self.item(i, |p| p.number(value)) {
                Some(number) => vector[i] = number,
                None => whole = false,
            }
        }
        whole.then_some((vector, Dimension::of_length(list.len())?))
    }

    pub(super) fn direction(&mut self, value: &Value, dimension: Option<Dimension>) -> Option<([f64; 3], Dimension)> {
        let (v, dimension) = self.vector(value, dimension)?;
        let length = (v[0] * v[0] + v[1] * v[1] + v[2] * v[2]).sqrt();
        if length < SMALLEST {
            self.fault("zero_vector", "a vector of length 0 has no direction");
            return None;
        }
        Some((v.map(|c| c / length), dimension))
    }

    pub(super) fn polygon(&mut self, value: &Value) -> Option<Vec<[f64; 2]>> {
        let Some(list) = value.as_array() else {
            self.fault("wrong_type", format!("a polygon is a list of points, and this is {}", type_name(value)));
            return None;
        };
        self.points += list.len();
        if list.len() > MAX_POLYGON || self.points > MAX_POINTS {
            let detail = format!("a polygon has at most {MAX_POLYGON} points, all polygons together {MAX_POINTS}");
            self.fault("too_many_points", detail);
            return None;
        }
        if list.len() < 3 {
            self.fault("too_few_points", format!("a polygon has at least 3 points, and this one has {}", list.len()));
            return None;
        }
        let mut points = Vec::with_capacity(list.len());
        for (i, value) in list.iter().enumerate() {
            if let Some((v, _)) = self.item(i, |p| p.vector(value, Some(Dimension::Two))) {
                points.push([v[0], v[1]]);
            }
        }
        if points.len() < list.len() {
            return None;
        }
        match defect(&points) {
            None => Some(points),
            Some(Defect::Repeated(i)) => {
                self.item(i, |p| {
                    p.fault("repeated_point", "the point equals the one before it (a polygon closes by itself)")
                });
                None
            }
            Some(Defect::Crossing(i, j)) => {
                self.fault("self_intersecting", format!("the edges from points {i} and {j} cross or touch"));
                None
            }
        }
    }
}
