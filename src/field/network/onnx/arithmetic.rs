//! Operators that compute: on constants whatever they say, on forms what keeps them affine, and activations.

use super::forms::{Core, Forms, Unit};
use super::operators::{Call, known, one};
use super::shapes;
use super::tensor::Tensor;
use super::value::{Aligned, Axes, Value, Varying, align};
use crate::field::FieldError;
use crate::field::network::Activation;
use std::f64::consts::FRAC_PI_2;
use std::rc::Rc;

/// From this argument on a softplus may be exchanged for its asymptote: e^-15 is a rounding of single precision beside 15.
const SOFTPLUS_IS_LINEAR: f64 = 15.0;
/// How far, relative to it, a factor may be from the one that it stands for.
const SAME_FACTOR: f64 = 1e-6;
/// A bound as large as this does not bound anything.
const UNBOUNDED: f64 = 1e30;

/// Two tensors, element by element.
pub(super) fn binary(call: &mut Call<'_, '_>) -> Result<Vec<Value>, FieldError> {
    let operator = call.node.operator;
    if call.arguments.len() != 2 {
        return Err(call.refused(&format!("{} inputs", call.arguments.len())));
    }
    let (a, b) = (call.argument(0)?, call.argument(1)?);
    match (a, b, operator) {
        (Value::Constant(a), Value::Constant(b), _) => one(Value::Constant(Rc::new(fold(call, &a, &b)?))),
        (a, b, "Add") => one(sum(call, &a, &b, 1.0)?),
        (a, b, "Sub") => one(sum(call, &a, &b, -1.0)?),
        (Value::Varying(a), Value::Constant(b), "Mul" | "Div") => one(scale(call, &a, &b)?),
        (Value::Constant(a), Value::Varying(b), "Mul") => one(scale(call, &b, &a)?),
        (Value::Varying(a), Value::Varying(b), "Mul") if a.forms.is_constant() => one(scale_repeated(call, &b, &a)?),
        (Value::Varying(a), Value::Varying(b), "Mul" | "Div") if b.forms.is_constant() => {
            one(scale_repeated(call, &a, &b)?)
        }
        (Value::Varying(a), Value::Constant(b), "Greater" | "GreaterOrEqual") => match b.numbers.as_slice() {
            [threshold] if !threshold.is_nan() && b.shape.len() <= a.shape.len() => one(Value::Over(a, *threshold)),
            _ => Err(call.refused("more than one threshold")),
        },
        (Value::Varying(_), Value::Varying(_), "Mul" | "Div") => {
            Err(call.refused("a product of two values that depend on the point"))
        }
        _ => Err(call.refused("of a value that depends on the point")),
    }
}

/// The node's operator on two constants.
fn fold(call: &mut Call<'_, '_>, a: &Tensor, b: &Tensor) -> Result<Tensor, FieldError> {
    let integer = a.integer && b.integer;
    let truth = |x: bool| f64::from(u8::from(x));
    let f: fn(f64, f64) -> f64 = match call.node.operator {
        "Add" => |x, y| x + y,
        "Sub" => |x, y| x - y,
        "Mul" => |x, y| x * y,
        "Div" if integer => |x, y| (x / y).trunc(),
        "Div" => |x, y| x / y,
        "Pow" => f64::powf,
        "Max" => |x, y| if x.is_nan() || y.is_nan() { f64::NAN } else { x.max(y) },
        "Min" => |x, y| if x.is_nan() || y.is_nan() { f64::NAN } else { x.min(y) },
        // a length that is not known is the length of an axis, and those are not compared with one another
        "Equal" => |x, y| f64::from(u8::from(x == y)),
        other => {
            let over = |x: f64, y: f64| match other {
                "Greater" => x > y,
                "GreaterOrEqual" => x >= y,
                _ => x < y,
            };
            let places = broadcast(call, a, b)?;
            let numbers = pairs(a, b, &places).map(|(x, y)| truth(over(x, y))).collect();
            return checked(call, Tensor { shape: places.0, integer: true, numbers });
        }
    };
    let places = broadcast(call, a, b)?;
    let numbers = pairs(a, b, &places).map(|(x, y)| f(x, y)).collect();
    checked(call, Tensor { shape: places.0, integer: integer || call.node.operator == "Equal", numbers })
}

type Places = (Vec<usize>, [Vec<usize>; 2]);

fn broadcast(call: &mut Call<'_, '_>, a: &Tensor, b: &Tensor) -> Result<Places, FieldError> {
    let (a, b) = ((Vec::new(), a.shape.clone()), (Vec::new(), b.shape.clone()));
    let Aligned { shape, places, .. } = aligned(call, &a, &b)?;
    Ok((shape, places))
}

fn pairs<'t>(a: &'t Tensor, b: &'t Tensor, places: &'t Places) -> impl Iterator<Item = (f64, f64)> + 't {
    places.1[0].iter().zip(&places.1[1]).map(|(&i, &j)| (a.numbers[i], b.numbers[j]))
}

fn aligned(call: &mut Call<'_, '_>, a: &Axes, b: &Axes) -> Result<Aligned, FieldError> {
    let aligned = align(a, b, call.budget)?;
    aligned.ok_or_else(|| call.fault(&format!("shapes that do not fit, {} and {}", described(a), described(b))))
}

/// A shape for a message.
fn described((lead, shape): &Axes) -> String {
    let lead = lead.iter().map(|length| length.map_or("n".to_owned(), |l| l.to_string()));
    format!("[{}]", lead.chain(shape.iter().map(ToString::to_string)).collect::<Vec<_>>().join(", "))
}

/// A constant that was computed: finite, or else the node is at fault.
fn checked(call: &Call<'_, '_>, tensor: Tensor) -> Result<Tensor, FieldError> {
    match tensor.numbers.iter().find(|v| !v.is_finite()) {
        None => Ok(tensor),
        Some(v) if v.is_nan() && tensor.integer => Err(call.refused("computing with the number of points")),
        Some(_) => Err(call.fault("it gives a number that is not finite")),
    }
}

/// A constant beside something that depends on the point: its last axes, and the leading axes that the rest stands beside.
fn beside(call: &mut Call<'_, '_>, constant: &Tensor, varying: &Varying) -> Result<(Tensor, Axes), FieldError> {
    let own = varying.shape.len();
    let extra = constant.shape.len().saturating_sub(own);
    let last = constant.last_axes(own, call.budget)?;
    let last = last.ok_or_else(|| call.refused("a constant that is another one for every point"))?;
    if last.numbers.iter().any(|v| v.is_nan()) {
        return Err(call.refused("computing with the number of points"));
    }
    let axes = (vec![Some(1); extra], last.shape.clone());
    Ok((last, axes))
}

fn finite(call: &Call<'_, '_>, varying: Varying) -> Result<Value, FieldError> {
    if varying.forms.scale.iter().chain(&varying.forms.shift).all(|v| v.is_finite()) {
        Ok(Value::Varying(varying))
    } else {
        Err(call.fault("it gives a number that is not finite"))
    }
}

/// A summand as forms, whose other summand is `other`.
fn summand(call: &mut Call<'_, '_>, value: &Value, other: &Value) -> Result<(Rc<Forms>, Axes), FieldError> {
    match (value, other) {
        (Value::Varying(varying), _) => Ok((varying.forms.clone(), varying.axes())),
        (Value::Constant(constant), Value::Varying(other)) => {
            let (last, axes) = beside(call, constant, other)?;
            call.budget.numbers(2 * last.len())?;
            Ok((Rc::new(Forms::constant(last.numbers)), axes))
        }
        _ => Err(call.refused("of truth values")),
    }
}

/// `a + sign b`, of which at least one depends on the point.
fn sum(call: &mut Call<'_, '_>, a: &Value, b: &Value, sign: f64) -> Result<Value, FieldError> {
    let (a, b) = (summand(call, a, b)?, summand(call, b, a)?);
    let Aligned { lead, shape, places } = aligned(call, &a.1, &b.1)?;
    let (a, mut b) = (a.0.take(&places[0], call.budget)?, b.0.take(&places[1], call.budget)?);
    if sign != 1.0 {
        b = b.scaled(&vec![sign; b.len()], &vec![0.0; b.len()]);
    }
    let forms = Rc::new(a.plus(&b, call.stages, call.budget)?);
    finite(call, Varying { lead, shape, forms })
}

/// Multiplied or, by a `Div`, divided by a constant.
fn scale(call: &mut Call<'_, '_>, varying: &Varying, factor: &Tensor) -> Result<Value, FieldError> {
    let (factor, axes) = beside(call, factor, varying)?;
    scale_by(call, varying, &factor.numbers, &axes)
}

/// The same with a constant that was repeated for every point.
fn scale_repeated(call: &mut Call<'_, '_>, varying: &Varying, factor: &Varying) -> Result<Value, FieldError> {
    scale_by(call, varying, &factor.forms.shift, &factor.axes())
}

fn scale_by(call: &mut Call<'_, '_>, varying: &Varying, factors: &[f64], axes: &Axes) -> Result<Value, FieldError> {
    let Aligned { lead, shape, places } = aligned(call, &varying.axes(), axes)?;
    let inverse = call.node.operator == "Div";
    let factors: Vec<f64> = places[1].iter().map(|&p| if inverse { 1.0 / factors[p] } else { factors[p] }).collect();
    let forms = varying.forms.take(&places[0], call.budget)?;
    let forms = Rc::new(forms.scaled(&factors, &vec![0.0; factors.len()]));
    finite(call, Varying { lead, shape, forms })
}

/// A function of one number.
pub(super) fn unary(call: &mut Call<'_, '_>) -> Result<Vec<Value>, FieldError> {
    let f: fn(f64) -> f64 = match call.node.operator {
        "Neg" => |x| -x,
        "Sqrt" => f64::sqrt,
        "Exp" => f64::exp,
        "Log" => f64::ln,
        "Abs" => f64::abs,
        _ => |x| 1.0 / x,
    };
    match call.argument(0)? {
        Value::Constant(constant) => mapped(call, &constant, f),
        Value::Varying(varying) if call.node.operator == "Neg" => {
            let n = varying.forms.len();
            call.budget.numbers(2 * n)?;
            let forms = varying.forms.scaled(&vec![-1.0; n], &vec![0.0; n]);
            one(Value::Varying(varying.with(varying.shape.clone(), forms)))
        }
        _ => Err(call.refused("of a value that depends on the point")),
    }
}

fn mapped(call: &mut Call<'_, '_>, constant: &Tensor, f: impl Fn(f64) -> f64) -> Result<Vec<Value>, FieldError> {
    if constant.numbers.iter().any(|v| v.is_nan()) {
        return Err(call.refused("computing with the number of points"));
    }
    call.budget.numbers(constant.len())?;
    let numbers = constant.numbers.iter().map(|&x| f(x)).collect();
    known(checked(call, Tensor { shape: constant.shape.clone(), integer: constant.integer, numbers })?)
}

/// An activation: a stage of the network, or of constants a number.
pub(super) fn activation(call: &mut Call<'_, '_>) -> Result<Vec<Value>, FieldError> {
    let cosine = call.node.operator == "Cos";
    let (activation, f): (Activation, fn(f64) -> f64) = match call.node.operator {
        "Relu" => (Activation::Relu, |x| x.max(0.0)),
        "Tanh" => (Activation::Tanh, f64::tanh),
        "Sigmoid" => (Activation::Sigmoid, |x| 1.0 / (1.0 + (-x).exp())),
        "Softplus" => (Activation::Softplus { beta: 1.0 }, |x| x.max(0.0) + (-x.abs()).exp().ln_1p()),
        "Elu" => {
            let alpha = call.float("alpha", 1.0)?;
            if alpha != 1.0 {
                return Err(call.refused(&format!("with the factor {alpha} (read is 1)")));
            }
            (Activation::Elu, |x| if x > 0.0 { x } else { x.exp_m1() })
        }
        _ if cosine => (Activation::Sine { w0: 1.0 }, f64::cos),
        _ => (Activation::Sine { w0: 1.0 }, f64::sin),
    };
    match call.argument(0)? {
        Value::Constant(constant) => mapped(call, &constant, f),
        Value::Varying(varying) => {
            let forms = &varying.forms;
            call.budget.numbers(4 * forms.len())?;
            let forms = if forms.is_constant() {
                Forms::constant(forms.shift.iter().map(|&x| f(x)).collect())
            } else {
                // the cosine is the sine a quarter of a turn ahead
                let turned = if cosine {
                    Rc::new(forms.scaled(&vec![1.0; forms.len()], &vec![FRAC_PI_2; forms.len()]))
                } else {
                    forms.clone()
                };
                stage(call, &turned, activation)?
            };
            one(Value::Varying(varying.with(varying.shape.clone(), forms)))
        }
        Value::Over(..) => Err(call.refused("of truth values")),
    }
}

fn stage(call: &mut Call<'_, '_>, forms: &Rc<Forms>, activation: Activation) -> Result<Forms, FieldError> {
    if forms.len() == 0 {
        return Err(call.fault("an input without numbers"));
    }
    call.budget.numbers(4 * forms.len())?;
    call.stages.activate(forms, activation, call.node.title())
}

/// `Clip`: a ReLU where only 0 bounds it from below, nothing where nothing bounds it. Other clamps of a field would make its
/// gradient vanish where the field is needed.
pub(super) fn clip(call: &mut Call<'_, '_>) -> Result<Vec<Value>, FieldError> {
    let bound = |call: &Call<'_, '_>, at: usize, name: &str, none: f64| match call.optional(at) {
        Some(_) => match call.tensor(at)?.numbers.as_slice() {
            [bound] => Ok(*bound),
            _ => Err(call.fault(&format!("bound {at} is not one number"))),
        },
        None => call.float(name, none as f32),
    };
    let (low, high) = (bound(call, 1, "min", f64::from(f32::MIN))?, bound(call, 2, "max", f64::from(f32::MAX))?);
    match call.argument(0)? {
        Value::Constant(constant) => mapped(call, &constant, |x| x.max(low).min(high)),
        value if low <= -UNBOUNDED && high >= UNBOUNDED => one(value),
        Value::Varying(varying) if low == 0.0 && high >= UNBOUNDED && !varying.forms.is_constant() => {
            let forms = stage(call, &varying.forms, Activation::Relu)?;
            one(Value::Varying(varying.with(varying.shape.clone(), forms)))
        }
        _ => Err(call.refused("a clamp, outside which the field has no gradient (export the network without it)")),
    }
}

/// `Where`: of constants, or a softplus that some exporter spells with its asymptote for large arguments.
pub(super) fn choice(call: &mut Call<'_, '_>) -> Result<Vec<Value>, FieldError> {
    match (call.argument(0)?, call.argument(1)?, call.argument(2)?) {
        (Value::Constant(test), Value::Constant(a), Value::Constant(b)) => {
            let (test_axes, a_axes, b_axes) = (test.shape.clone(), a.shape.clone(), b.shape.clone());
            let of = |shape: Vec<usize>| (Vec::new(), shape);
            let all = aligned(call, &of(a_axes), &of(b_axes))?;
            let tested = aligned(call, &of(test_axes), &of(all.shape.clone()))?;
            let chosen = tested.places[0].iter().zip(&tested.places[1]);
            let pick = |(&t, &i): (&usize, &usize)| {
                if test.numbers[t] == 0.0 { b.numbers[all.places[1][i]] } else { a.numbers[all.places[0][i]] }
            };
            let numbers = chosen.map(pick).collect();
            known(Tensor { shape: tested.shape, integer: a.integer && b.integer, numbers })
        }
        (Value::Over(test, threshold), Value::Varying(linear), Value::Varying(softplus))
            if is_softplus(call, &test, threshold, &linear, &softplus) =>
        {
            one(Value::Varying(softplus))
        }
        _ => Err(call.refused("a choice that depends on the point")),
    }
}

/// Whether `test > threshold ? linear : softplus` is the softplus but for rounding.
fn is_softplus(call: &Call<'_, '_>, test: &Varying, threshold: f64, linear: &Varying, softplus: &Varying) -> bool {
    let Core::Units(units) = &softplus.forms.core else { return false };
    let Some(&Unit { stage: at, .. }) = units.first() else { return false };
    let Some(stage) = call.stages.stage(at) else { return false };
    let Activation::Softplus { beta } = stage.activation else { return false };
    let (out, before) = (&softplus.forms, &stage.forms);
    let in_order = units.iter().enumerate().all(|(place, unit)| *unit == Unit { stage: at, place });
    let alike = in_order
        && units.len() == before.len()
        && [test, linear]
            .iter()
            .all(|v| v.shape == softplus.shape && v.lead == softplus.lead && v.forms.same_core(before));
    let same = |a: f64, b: f64| (a - b).abs() <= SAME_FACTOR * a.abs().max(b.abs());
    alike
        && (0..before.len()).all(|i| {
            let (line, tested) = (&linear.forms, &test.forms);
            let ratio = tested.scale[i] / before.scale[i];
            ratio > 0.0
                && same(tested.shift[i], ratio * before.shift[i])
                && same(line.scale[i], out.scale[i] * before.scale[i])
                && same(line.shift[i], out.scale[i] * before.shift[i])
                && out.shift[i] == 0.0
                && f64::from(beta) * threshold / ratio >= SOFTPLUS_IS_LINEAR
        })
}

/// A constant as a matrix of `inner` rows, and its columns.
fn matrix(call: &mut Call<'_, '_>, constant: &Tensor, inner: usize) -> Result<(Vec<f64>, usize), FieldError> {
    let last = constant.last_axes(2, call.budget)?.filter(|m| m.numbers.iter().all(|v| v.is_finite()));
    let last = last.ok_or_else(|| call.refused("a stack of matrices"))?;
    let (rows, columns) = match *last.shape.as_slice() {
        [rows] => (rows, 1),
        [rows, columns] => (rows, columns),
        _ => return Err(call.fault("a product with a single number")),
    };
    if rows != inner || rows == 0 || columns == 0 {
        return Err(call.fault(&format!("a matrix of {rows} rows and {columns} columns for {inner} numbers")));
    }
    Ok((last.numbers, columns))
}

/// `MatMul` with a constant on the right, or of two constants.
pub(super) fn matmul(call: &mut Call<'_, '_>) -> Result<Vec<Value>, FieldError> {
    let right = call.tensor(1)?;
    let vector = right.shape.len() == 1;
    match call.argument(0)? {
        Value::Varying(varying) => {
            let Some((&inner, rest)) = varying.shape.split_last() else {
                return Err(call.refused("a product over the points"));
            };
            let (matrix, outer) = matrix(call, &right, inner)?;
            let mut shape = rest.to_vec();
            if !vector {
                shape.push(outer);
            }
            one(Value::Varying(product(call, &varying, shape, &matrix, outer)?))
        }
        Value::Constant(left) => {
            let Some((&inner, rest)) = left.shape.split_last() else {
                return Err(call.fault("a product with a single number"));
            };
            let (matrix, outer) = matrix(call, &right, inner)?;
            let mut shape = rest.to_vec();
            if !vector {
                shape.push(outer);
            }
            let rows = left.len() / inner;
            known(constant_product(call, &left.numbers, &matrix, [rows, inner, outer], shape)?)
        }
        Value::Over(..) => Err(call.refused("of truth values")),
    }
}

fn constant_product(
    call: &mut Call<'_, '_>,
    left: &[f64],
    right: &[f64],
    [rows, inner, outer]: [usize; 3],
    shape: Vec<usize>,
) -> Result<Tensor, FieldError> {
    call.budget.numbers(rows.saturating_mul(outer))?;
    call.budget.work(rows.saturating_mul(outer).saturating_mul(inner))?;
    let mut numbers = vec![0.0; rows * outer];
    for (row, sums) in left.chunks_exact(inner).zip(numbers.chunks_exact_mut(outer)) {
        for (x, weights) in row.iter().zip(right.chunks_exact(outer)) {
            sums.iter_mut().zip(weights).for_each(|(sum, w)| *sum += x * w);
        }
    }
    checked(call, Tensor { shape, integer: false, numbers })
}

/// The forms times a matrix. What would take too long to multiply out becomes a layer without an activation.
fn product(
    call: &mut Call<'_, '_>,
    varying: &Varying,
    shape: Vec<usize>,
    matrix: &[f64],
    outer: usize,
) -> Result<Varying, FieldError> {
    let mut forms = varying.forms.clone();
    let inner = matrix.len() / outer;
    if !call.budget.affords(forms.cost_of_times(outer)) && !forms.is_constant() {
        forms = Rc::new(stage(call, &forms, Activation::Identity)?);
    }
    let groups = forms.len() / inner;
    let forms = forms.times(matrix, [groups, inner, outer], call.stages, call.budget)?;
    match finite(call, varying.with(shape, forms))? {
        Value::Varying(varying) => Ok(varying),
        _ => Err(call.refused("")),
    }
}

/// `alpha A B + beta C`, the first two perhaps transposed.
pub(super) fn gemm(call: &mut Call<'_, '_>) -> Result<Vec<Value>, FieldError> {
    let (alpha, beta) = (call.float("alpha", 1.0)?, call.float("beta", 1.0)?);
    if call.int("transA", 0)? != 0 {
        return Err(call.refused("with its first input transposed"));
    }
    let right = call.tensor(1)?;
    let [rows, columns] = *right.shape.as_slice() else {
        return Err(call.fault("the second input is not a matrix"));
    };
    call.budget.numbers(right.len())?;
    let (inner, outer, mut matrix) = if call.int("transB", 0)? == 0 {
        (rows, columns, right.numbers.clone())
    } else {
        let places = shapes::permuted_indices(&right.shape, &[1, 0]);
        (columns, rows, places.into_iter().map(|p| right.numbers[p]).collect())
    };
    if alpha != 1.0 {
        matrix.iter_mut().for_each(|w| *w *= alpha);
    }
    let fits = |found: usize| found == inner && inner > 0 && outer > 0;
    let misfit = |call: &Call<'_, '_>, found: usize| {
        call.fault(&format!("a matrix of {inner} rows and {outer} columns for {found} numbers"))
    };
    let value = match call.argument(0)? {
        Value::Varying(varying) => match *varying.shape.as_slice() {
            [found] if fits(found) => Value::Varying(product(call, &varying, vec![outer], &matrix, outer)?),
            [found] => return Err(misfit(call, found)),
            _ => return Err(call.refused("a product over the points")),
        },
        Value::Constant(left) => match *left.shape.as_slice() {
            [rows, found] if fits(found) => Value::Constant(Rc::new(constant_product(
                call,
                &left.numbers,
                &matrix,
                [rows, inner, outer],
                vec![rows, outer],
            )?)),
            _ => return Err(misfit(call, left.shape.last().copied().unwrap_or(0))),
        },
        Value::Over(..) => return Err(call.refused("of truth values")),
    };
    let summand = match call.optional(2) {
        None => return one(value),
        Some(_) if beta == 0.0 => return one(value),
        Some(summand) if beta == 1.0 => summand,
        Some(Value::Constant(c)) => {
            call.budget.numbers(c.len())?;
            let numbers = c.numbers.iter().map(|v| beta * v).collect();
            Value::Constant(Rc::new(Tensor { numbers, ..(*c).clone() }))
        }
        Some(_) => return Err(call.refused("with a scaled summand that depends on the point")),
    };
    match (&value, &summand) {
        (Value::Constant(a), Value::Constant(b)) => {
            let places = broadcast(call, a, b)?;
            let numbers = pairs(a, b, &places).map(|(x, y)| x + y).collect();
            known(checked(call, Tensor { shape: places.0, integer: false, numbers })?)
        }
        _ => one(sum(call, &value, &summand, 1.0)?),
    }
}

/// Sums over axes: of constants, and the plain sum and mean over the last axis of something that depends on the point.
pub(super) fn reduce(call: &mut Call<'_, '_>) -> Result<Vec<Value>, FieldError> {
    let operator = call.node.operator;
    let keep = call.int("keepdims", 1)? != 0;
    let listed = call.list("axes", 1)?;
    if listed.as_ref().is_none_or(Vec::is_empty) && call.int("noop_with_empty_axes", 0)? != 0 {
        return Err(call.refused("over no axis"));
    }
    let value = call.argument(0)?;
    let rank = match &value {
        Value::Constant(constant) => constant.shape.len(),
        Value::Varying(varying) => varying.rank(),
        Value::Over(..) => return Err(call.refused("of truth values")),
    };
    let mut gone = vec![listed.as_ref().is_none_or(Vec::is_empty); rank];
    for &number in listed.iter().flatten() {
        let axis = shapes::axis(number, rank).ok_or_else(|| call.fault(&format!("axis {number} of {rank}")))?;
        gone[axis] = true;
    }
    match value {
        Value::Constant(constant) => {
            let reduced: Vec<usize> = constant.shape.iter().zip(&gone).map(|(&l, &g)| if g { 1 } else { l }).collect();
            let size = shapes::count(&reduced).unwrap_or(usize::MAX);
            call.budget.numbers(size.saturating_add(constant.len()))?;
            let mut numbers = vec![0.0; size];
            // where every element goes: the reduced tensor broadcast to the whole one
            for (&place, x) in shapes::broadcast_indices(&reduced, &constant.shape).iter().zip(&constant.numbers) {
                numbers[place] += if matches!(operator, "ReduceL2" | "ReduceSumSquare") { x * x } else { *x };
            }
            let share = constant.len() as f64 / size as f64;
            match operator {
                "ReduceL2" => numbers.iter_mut().for_each(|x| *x = x.sqrt()),
                "ReduceMean" => numbers.iter_mut().for_each(|x| *x /= share),
                _ => {}
            }
            let kept = reduced.iter().zip(&gone).filter(|(_, gone)| keep || !**gone).map(|(&l, _)| l).collect();
            known(checked(call, Tensor { shape: kept, integer: constant.integer, numbers })?)
        }
        Value::Varying(varying) => {
            let last_alone =
                gone.iter().rposition(|&g| g) == Some(rank - 1) && gone.iter().filter(|&&g| g).count() == 1;
            let linear = matches!(operator, "ReduceSum" | "ReduceMean");
            let (Some((&inner, rest)), true) = (varying.shape.split_last(), last_alone && linear) else {
                return Err(call.refused("of a value that depends on the point, but for a sum over its columns"));
            };
            if inner == 0 {
                return Err(call.fault("an input without numbers"));
            }
            let weight = if operator == "ReduceMean" { 1.0 / inner as f64 } else { 1.0 };
            let mut shape = rest.to_vec();
            if keep {
                shape.push(1);
            }
            call.budget.numbers(inner)?;
            one(Value::Varying(product(call, &varying, shape, &vec![weight; inner], 1)?))
        }
        Value::Over(..) => Err(call.refused("of truth values")),
    }
}
