//! Records as messages, and messages as JSON.

use super::proto;
use crate::field::Fault;
use crate::http::Problem;
use crate::job::{Event, Job, Output, State};
use jiff::Timestamp;
use prost_types::value::Kind;
use prost_types::{ListValue, Struct, Value as Message};
use serde::Serialize;
use serde_json::{Map, Number, Value};

/// Whole numbers up to here are the same as doubles.
const EXACT: f64 = 9_007_199_254_740_992.0;

/// A job as it is told.
pub fn job(job: &Job) -> proto::Job {
    proto::Job {
        id: job.id.to_string(),
        kind: job.kind.name().to_owned(),
        state: state(job.state).into(),
        attempt: job.attempt,
        revision: job.revision,
        created_at: Some(time(job.created_at)),
        started_at: job.started_at.map(time),
        finished_at: job.finished_at.map(time),
        progress: job.progress.as_ref().and_then(object),
        metrics: job.metrics.as_ref().and_then(object),
        outputs: job.outputs.iter().map(output).collect(),
        problem: job.problem.as_ref().and_then(object),
        labels: job.labels.clone().into_iter().collect(),
        eta_s: job.eta_s,
        shrink: job.shrink.as_ref().and_then(object),
        fit: job.fit.as_ref().and_then(object),
        of: job.of.map(|id| id.to_string()).unwrap_or_default(),
    }
}

fn output(output: &Output) -> proto::Output {
    proto::Output {
        name: output.name.clone(),
        media_type: output.media_type.clone(),
        bytes: output.bytes,
        sha256: output.sha256.clone(),
        href: output.href.clone(),
        certified: output.certified,
    }
}

/// An event as it is told.
pub fn event(event: &Event) -> proto::Event {
    proto::Event {
        id: event.seq,
        kind: event.kind.name().to_owned(),
        data: object(&event.data),
        at: Some(time(event.at)),
    }
}

fn state(state: State) -> proto::State {
    match state {
        State::Queued => proto::State::Queued,
        State::Running => proto::State::Running,
        State::Canceling => proto::State::Canceling,
        State::Succeeded => proto::State::Succeeded,
        State::Failed => proto::State::Failed,
        State::Canceled => proto::State::Canceled,
    }
}

/// The state of that number; `None` for one that is none.
pub fn read_state(number: i32) -> Option<State> {
    State::ALL.into_iter().find(|&known| i32::from(state(known)) == number)
}

/// A time as it is told.
pub fn time(at: Timestamp) -> prost_types::Timestamp {
    prost_types::Timestamp { seconds: at.as_second(), nanos: at.subsec_nanosecond() }
}

/// A time that was asked for.
pub fn read_time(name: &str, at: prost_types::Timestamp) -> Result<Timestamp, Problem> {
    Timestamp::new(at.seconds, at.nanos).map_err(|_| Problem::query(format!("{name}: no time that is understood")))
}

/// A value that is a JSON object, as a message; `None` for what is none.
pub fn object(value: &impl Serialize) -> Option<Struct> {
    match serde_json::to_value(value) {
        Ok(Value::Object(members)) => Some(members_of(members)),
        _ => None,
    }
}

fn members_of(members: Map<String, Value>) -> Struct {
    Struct { fields: members.into_iter().map(|(name, value)| (name, message(value))).collect() }
}

fn message(value: Value) -> Message {
    let kind = match value {
        Value::Null => Kind::NullValue(0),
        Value::Bool(b) => Kind::BoolValue(b),
        Value::Number(n) => Kind::NumberValue(n.as_f64().unwrap_or_default()),
        Value::String(s) => Kind::StringValue(s),
        Value::Array(list) => Kind::ListValue(ListValue { values: list.into_iter().map(message).collect() }),
        Value::Object(members) => Kind::StructValue(members_of(members)),
    };
    Message { kind: Some(kind) }
}

/// A request in either of its two forms, as JSON.
///
/// # Errors
/// What HTTP answers to the same text, and a fault where a number is none that JSON knows.
pub fn request(spec: Option<Struct>, json: &str) -> Result<Value, Problem> {
    match (spec, json) {
        (Some(spec), "") => {
            let mut faults = Vec::new();
            let value = read_members(spec, "", &mut faults);
            if faults.is_empty() { Ok(value) } else { Err(Problem::invalid_request("", &faults)) }
        }
        (None, "") => Err(Problem::invalid_request("", &[ambiguous("give spec or json")])),
        (None, text) => crate::http::body::parse_json(text.as_bytes()),
        (Some(_), _) => Err(Problem::invalid_request("", &[ambiguous("give spec or json, not both")])),
    }
}

fn ambiguous(detail: &str) -> Fault {
    Fault { pointer: String::new(), code: "ambiguous", detail: detail.to_owned() }
}

fn read_members(members: Struct, pointer: &str, faults: &mut Vec<Fault>) -> Value {
    let read = members.fields.into_iter().map(|(name, value)| {
        let pointer = format!("{pointer}/{}", name.replace('~', "~0").replace('/', "~1"));
        let value = read_value(value, &pointer, faults);
        (name, value)
    });
    Value::Object(read.collect())
}

fn read_value(value: Message, pointer: &str, faults: &mut Vec<Fault>) -> Value {
    match value.kind {
        None | Some(Kind::NullValue(_)) => Value::Null,
        Some(Kind::BoolValue(b)) => Value::Bool(b),
        Some(Kind::NumberValue(n)) => number(n).unwrap_or_else(|| {
            let detail = format!("expected a number, found {n}");
            faults.push(Fault { pointer: pointer.to_owned(), code: "wrong_type", detail });
            Value::Null
        }),
        Some(Kind::StringValue(s)) => Value::String(s),
        Some(Kind::ListValue(list)) => {
            let values = list.values.into_iter().enumerate();
            Value::Array(values.map(|(i, value)| read_value(value, &format!("{pointer}/{i}"), faults)).collect())
        }
        Some(Kind::StructValue(members)) => read_members(members, pointer, faults),
    }
}

/// A double as JSON: a whole number where it is one, because a message does not tell 2 from 2.0.
fn number(n: f64) -> Option<Value> {
    if n.fract() == 0.0 && n.abs() <= EXACT && !(n == 0.0 && n.is_sign_negative()) {
        return Some(Value::Number(Number::from(n as i64)));
    }
    Number::from_f64(n).map(Value::Number)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use serde_json::json;

    #[test]
    fn whole_numbers_stay_whole_and_what_is_no_number_is_a_fault_at_its_place() {
        let value = json!({"a/b": [1, 2.5, -3, {"x": null}], "c": true, "d": "text", "zero": 0});
        let message = object(&value).expect("an object");
        assert_eq!(request(Some(message), "").expect("reads"), value);
        let mut message = object(&json!({"a/b": [1]})).expect("an object");
        let Some(Kind::ListValue(list)) = &mut message.fields.get_mut("a/b").expect("a/b").kind else {
            panic!("a list")
        };
        list.values[0].kind = Some(Kind::NumberValue(f64::NAN));
        let problem = request(Some(message), "").expect_err("no number");
        assert_eq!(problem.errors()[0].pointer, "/a~1b/0");
    }

    #[test]
    fn exactly_one_form_is_taken() {
        let spec = || object(&json!({"field": {}}));
        assert_eq!(request(None, "{\"field\": {}}").expect("reads"), json!({"field": {}}));
        assert_eq!(request(None, "").expect_err("none").code(), "invalid_request");
        assert_eq!(request(spec(), "{}").expect_err("both").code(), "invalid_request");
        assert_eq!(request(None, "{").expect_err("broken").code(), "malformed_json");
    }

    #[test]
    fn every_state_is_read_back() {
        for known in State::ALL {
            assert_eq!(read_state(state(known).into()), Some(known));
        }
        assert_eq!((read_state(0), read_state(99)), (None, None));
    }

    proptest! {
        #[test]
        fn a_double_comes_back_as_itself(n in any::<f64>()) {
            let back = number(n).map(|value| value.as_f64().expect("a number"));
            prop_assert_eq!(back.map(f64::to_bits), n.is_finite().then(|| n.to_bits()));
        }
    }
}
