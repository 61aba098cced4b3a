//! Index arithmetic of row-major tensors: which element of the input every element of the output is.

/// Number of elements, or `None` where it is too large to be counted. Other axes of something empty may have any length.
pub(super) fn count(shape: &[usize]) -> Option<usize> {
    if shape.contains(&0) {
        return Some(0);
    }
    shape.iter().try_fold(1usize, |product, &length| product.checked_mul(length))
}

/// The axis that a number from the file means, counted from the end where it is negative.
pub(super) fn axis(number: i64, rank: usize) -> Option<usize> {
    let number = if number < 0 { number.checked_add(rank as i64)? } else { number };
    usize::try_from(number).ok().filter(|&axis| axis < rank)
}

/// The shape that two shapes are broadcast to.
pub(super) fn broadcast(a: &[usize], b: &[usize]) -> Option<Vec<usize>> {
    let rank = a.len().max(b.len());
    (0..rank)
        .map(|i| {
            let of = |shape: &[usize]| (i + shape.len()).checked_sub(rank).map_or(1, |at| shape[at]);
            match (of(a), of(b)) {
                (x, y) if x == y => Some(x),
                (1, y) => Some(y),
                (x, 1) => Some(x),
                _ => None,
            }
        })
        .collect()
}

/// Distance in memory of neighbours along every axis.
fn strides(shape: &[usize]) -> Vec<usize> {
    let mut strides = vec![1usize; shape.len()];
    for i in (1..shape.len()).rev() {
        // what is not empty was counted; of what is empty no element is asked for
        strides[i - 1] = strides[i].wrapping_mul(shape[i]);
    }
    strides
}

/// Walks a shape in order; every element's place is the sum of its coordinates times `strides`.
fn walk(shape: &[usize], strides: &[usize]) -> Vec<usize> {
    if shape.contains(&0) {
        return Vec::new();
    }
    let mut indices = vec![0];
    for (&length, &stride) in shape.iter().zip(strides) {
        indices = indices.iter().flat_map(|&base| (0..length).map(move |i| base + i * stride)).collect();
    }
    indices
}

/// The elements of a tensor of shape `from` that is broadcast to `to`, which it fits.
pub(super) fn broadcast_indices(from: &[usize], to: &[usize]) -> Vec<usize> {
    let own = strides(from);
    let missing = to.len() - from.len();
    let strides: Vec<usize> =
        (0..to.len()).map(|i| if i < missing || from[i - missing] == 1 { 0 } else { own[i - missing] }).collect();
    walk(to, &strides)
}

/// The elements of a tensor whose axes are reordered: axis i of the result is axis `order[i]`.
pub(super) fn permuted_indices(shape: &[usize], order: &[usize]) -> Vec<usize> {
    let own = strides(shape);
    let lengths: Vec<usize> = order.iter().map(|&axis| shape[axis]).collect();
    let strides: Vec<usize> = order.iter().map(|&axis| own[axis]).collect();
    walk(&lengths, &strides)
}

/// The elements of a tensor of which only `kept` of an axis are taken, in that order.
pub(super) fn kept_indices(shape: &[usize], axis: usize, kept: &[usize]) -> Vec<usize> {
    if shape.contains(&0) || kept.is_empty() {
        return Vec::new();
    }
    let inner: usize = shape[axis + 1..].iter().product();
    let outer: usize = shape[..axis].iter().product();
    let mut indices = Vec::with_capacity(outer * kept.len() * inner);
    for o in 0..outer {
        for k in kept {
            let start = (o * shape[axis] + k) * inner;
            indices.extend(start..start + inner);
        }
    }
    indices
}

/// Start, end and step of a slice, as ONNX clamps them to an axis of `length`: the places that are taken.
pub(super) fn slice(start: i64, end: i64, step: i64, length: usize) -> Option<Vec<usize>> {
    if length == 0 {
        return (step != 0).then(Vec::new);
    }
    let n = length as i64;
    let from_end = |v: i64| if v < 0 { v.saturating_add(n) } else { v };
    let (start, end) = (from_end(start), from_end(end));
    if step > 0 {
        let (start, end) = (start.clamp(0, n), end.clamp(0, n));
        let step = usize::try_from(step).ok()?;
        Some((start..end).step_by(step).map(|i| i as usize).collect())
    } else {
        let (start, end) = (start.clamp(0, n - 1), end.clamp(-1, n - 1));
        let step = usize::try_from(step.checked_neg()?).ok().filter(|&step| step > 0)?;
        Some((end + 1..=start).rev().step_by(step).map(|i| i as usize).collect())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn indices_follow_the_axes() {
        assert_eq!(broadcast(&[2, 1], &[3]), Some(vec![2, 3]));
        assert_eq!(broadcast(&[2, 2], &[3]), None);
        assert_eq!(broadcast_indices(&[2, 1], &[2, 3]), [0, 0, 0, 1, 1, 1]);
        assert_eq!(broadcast_indices(&[3], &[2, 3]), [0, 1, 2, 0, 1, 2]);
        assert_eq!(permuted_indices(&[2, 3], &[1, 0]), [0, 3, 1, 4, 2, 5]);
        assert_eq!(kept_indices(&[2, 3, 2], 1, &[2, 0]), [4, 5, 0, 1, 10, 11, 6, 7]);
        let empty = [usize::MAX, usize::MAX, 0, usize::MAX];
        assert_eq!((count(&empty), permuted_indices(&empty, &[3, 2, 1, 0])), (Some(0), vec![]));
        assert_eq!((broadcast_indices(&[1], &empty), kept_indices(&empty, 0, &[7])), (vec![], vec![]));
        assert_eq!(axis(-1, 2), Some(1));
        assert_eq!(axis(i64::MIN, 2), None);
    }

    #[test]
    fn slices_are_clamped() {
        assert_eq!(slice(1, i64::MAX, 1, 4), Some(vec![1, 2, 3]));
        assert_eq!(slice(-2, i64::MAX, 1, 4), Some(vec![2, 3]));
        assert_eq!(slice(-1, i64::MIN, -1, 3), Some(vec![2, 1, 0]));
        assert_eq!(slice(0, 9, 2, 5), Some(vec![0, 2, 4]));
        assert_eq!(slice(3, 1, 1, 5), Some(vec![]));
        assert_eq!(slice(0, 5, 0, 5), None);
        assert_eq!(slice(i64::MIN, i64::MAX, i64::MIN, 5), None);
        assert_eq!(slice(0, 1, -1, 0), Some(vec![]));
    }
}
