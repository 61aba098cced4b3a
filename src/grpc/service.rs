//! The methods: translate messages for the functions that answer HTTP, and their answers into messages.

use super::call::{Deadline, exceeded};
use super::proto::shrinkd_server::Shrinkd;
use super::{message, proto, refusal};
use crate::auth::{Caller, Scope};
use crate::engine::{self, ListQuery};
use crate::field::input::FieldOptions;
use crate::http::inputs::{self, Stored};
use crate::http::{App, Problem, body, context, jobs, list, outputs};
use crate::tenant::Tenant;
use axum::http::StatusCode;
use bytes::{Bytes, BytesMut};
use futures::StreamExt as _;
use futures::stream::{self, BoxStream};
use sha2::{Digest as _, Sha256};
use tokio::time::Instant;
use tokio_util::sync::CancellationToken;
use tonic::{Request, Response, Status, Streaming};

/// Bytes of a piece of a download: what gRPC carries well, and far below what clients take at most.
const PIECE: usize = 64 << 10;

/// The service of [`proto`].
#[derive(Clone)]
pub struct Service {
    pub app: App,
}

/// What is known of a call besides its message.
struct Asked {
    request_id: String,
    deadline: Option<Instant>,
    caller: Option<Caller>,
}

impl Asked {
    fn of<T>(request: &Request<T>) -> Self {
        let id = request.metadata().get(context::REQUEST_ID.as_str()).and_then(|id| id.to_str().ok());
        Self {
            request_id: id.unwrap_or_default().to_owned(),
            deadline: request.extensions().get::<Deadline>().map(|deadline| deadline.0),
            caller: request.extensions().get::<Caller>().cloned(),
        }
    }

    /// Whose things it asks for, if it may do this with them.
    fn may(&self, scope: Scope) -> Result<Tenant, Problem> {
        let Some(caller) = &self.caller else {
            tracing::error!("a call does not know who asks");
            return Err(Problem::internal());
        };
        Ok(caller.may(scope)?.clone())
    }

    fn refuse(&self, problem: Problem) -> Status {
        tracing::debug!(problem.code = problem.code(), problem.detail = problem.detail(), "call refused");
        refusal::status(&problem, &self.request_id)
    }
}

type Answer<T> = Result<Response<T>, Status>;
type Told<T> = BoxStream<'static, Result<T, Status>>;

#[tonic::async_trait]
impl Shrinkd for Service {
    type WatchStream = Told<proto::Event>;
    type DownloadStream = Told<proto::Chunk>;

    async fn submit(&self, request: Request<proto::SubmitRequest>) -> Answer<proto::SubmitResponse> {
        let asked = Asked::of(&request);
        let submit = async {
            let tenant = asked.may(Scope::Write)?;
            let request = request.into_inner();
            let key = read_key(&request.idempotency_key)?;
            let spec = message::request(request.spec, &request.json)?;
            jobs::accept(&self.app, &tenant, &spec, key).await
        };
        let accepted = submit.await.map_err(|problem| asked.refuse(problem))?;
        let job = Some(message::job(&accepted.job));
        Ok(Response::new(proto::SubmitResponse { job, replayed: accepted.replayed }))
    }

    async fn estimate(&self, request: Request<proto::EstimateRequest>) -> Answer<proto::EstimateResponse> {
        let asked = Asked::of(&request);
        let judge = async {
            let tenant = asked.may(Scope::Write)?;
            let request = request.into_inner();
            jobs::judge(&self.app, &tenant, &message::request(request.spec, &request.json)?).await
        };
        let estimate = judge.await.map_err(|problem| asked.refuse(problem))?;
        let jobs::Estimate { vertices, evaluations, memory_bytes, .. } = estimate;
        Ok(Response::new(proto::EstimateResponse { vertices, evaluations, memory_bytes }))
    }

    async fn get(&self, request: Request<proto::GetRequest>) -> Answer<proto::Job> {
        let asked = Asked::of(&request);
        let read = async {
            let tenant = asked.may(Scope::Read)?;
            let id = jobs::job_id(&request.get_ref().id)?;
            self.app.engine.get(&tenant, id).await?.ok_or_else(|| Problem::unknown_job(&id.to_string()))
        };
        let job = read.await.map_err(|problem| asked.refuse(problem))?;
        Ok(Response::new(message::job(&job)))
    }

    async fn list(&self, request: Request<proto::ListRequest>) -> Answer<proto::ListResponse> {
        let asked = Asked::of(&request);
        let list = async {
            let tenant = asked.may(Scope::Read)?;
            list::page(&self.app, &tenant, read_query(request.into_inner())?).await
        };
        let page = list.await.map_err(|problem| asked.refuse(problem))?;
        let jobs = page.jobs.iter().map(message::job).collect();
        Ok(Response::new(proto::ListResponse { jobs, next_cursor: page.next_cursor.unwrap_or_default() }))
    }

    async fn cancel(&self, request: Request<proto::CancelRequest>) -> Answer<proto::Job> {
        let asked = Asked::of(&request);
        let cancel = async { jobs::request_cancel(&self.app, &asked.may(Scope::Write)?, &request.get_ref().id).await };
        let job = cancel.await;
        Ok(Response::new(message::job(&job.map_err(|problem| asked.refuse(problem))?)))
    }

    async fn forget(&self, request: Request<proto::ForgetRequest>) -> Answer<proto::ForgetResponse> {
        let asked = Asked::of(&request);
        let forget = async { jobs::remove(&self.app, &asked.may(Scope::Write)?, &request.get_ref().id).await };
        forget.await.map_err(|problem| asked.refuse(problem))?;
        Ok(Response::new(proto::ForgetResponse {}))
    }

    async fn watch(&self, request: Request<proto::WatchRequest>) -> Answer<Self::WatchStream> {
        let asked = Asked::of(&request);
        let follow = async {
            let tenant = asked.may(Scope::Read)?;
            let open = self.app.rates.open_stream(&tenant)?;
            let proto::WatchRequest { id, after } = request.into_inner();
            let id = jobs::job_id(&id)?;
            let events = engine::follow(self.app.engine.clone(), &tenant, id, after).await?;
            let events = events.ok_or_else(|| Problem::unknown_job(&id.to_string()))?;
            let told = events.map(move |event| {
                let _here = &open;
                Ok(message::event(event?.as_ref()))
            });
            Ok(told.boxed())
        };
        let events = follow.await.map_err(|problem| asked.refuse(problem))?;
        Ok(Response::new(bounded(events, asked, self.app.stop.clone())))
    }

    async fn download(&self, request: Request<proto::DownloadRequest>) -> Answer<Self::DownloadStream> {
        let asked = Asked::of(&request);
        let download = async {
            let tenant = asked.may(Scope::Read)?;
            let open = self.app.rates.open_stream(&tenant)?;
            let proto::DownloadRequest { id, name, offset } = request.into_inner();
            let made = outputs::find(&self.app, &tenant, &id, &name).await?;
            let bytes = made.output.bytes;
            if offset > bytes {
                let (title, detail) = ("the output has no such bytes", format!("the output has {bytes} bytes"));
                let status = StatusCode::RANGE_NOT_SATISFIABLE;
                return Err(Problem::new(status, "range_not_satisfiable", title, detail));
            }
            if offset == bytes {
                return Ok(stream::empty().boxed());
            }
            let source = outputs::read(&self.app, made.blob, Some(offset..bytes)).await?;
            let source = source.map(|piece| piece.map_err(Problem::from)).boxed();
            let hash = (offset == 0).then(|| (Sha256::new(), *made.blob.bytes()));
            let told = pieces(Source { source, buffer: BytesMut::new(), left: bytes - offset, hash });
            let told = told.map(move |piece| {
                let _here = &open;
                piece
            });
            Ok(told.boxed())
        };
        let pieces = download.await.map_err(|problem| asked.refuse(problem))?;
        let chunks = pieces.map(|piece| piece.map(|data| proto::Chunk { data })).boxed();
        Ok(Response::new(bounded(chunks, asked, self.app.stop.clone())))
    }

    async fn upload(&self, request: Request<Streaming<proto::Chunk>>) -> Answer<proto::UploadResponse> {
        let asked = Asked::of(&request);
        let tenant = asked.may(Scope::Write).map_err(|problem| asked.refuse(problem))?;
        let (mut chunks, limit) = (request.into_inner(), self.app.limits.input_bytes);
        let refuse = |problem| asked.refuse(problem);
        let read = async {
            let (mut bytes, mut room) = (BytesMut::new(), self.app.upload_room.taken());
            while let Some(chunk) = body::within(body::STALL, chunks.message()).await.map_err(refuse)?? {
                if (bytes.len() + chunk.data.len()) as u64 > limit {
                    return Err(refuse(Problem::too_large(limit)));
                }
                room.more(chunk.data.len() as u64).map_err(refuse)?;
                bytes.extend_from_slice(&chunk.data);
            }
            Ok((bytes.freeze(), room))
        };
        let (bytes, _room) = body::within(body::WHOLE, read).await.map_err(refuse)??;
        let stored = inputs::store(&self.app, &tenant, bytes, FieldOptions::default()).await;
        let (Stored::Known(input) | Stored::New(input)) = stored.map_err(|problem| asked.refuse(problem))?;
        Ok(Response::new(proto::UploadResponse {
            id: input.id.to_string(),
            bytes: input.bytes,
            created_at: Some(message::time(input.created_at)),
            description: message::object(&input.description),
        }))
    }
}

fn read_key(text: &str) -> Result<Option<String>, Problem> {
    if text.is_empty() {
        return Ok(None);
    }
    let wrong = || Problem::header(format!("idempotency_key: expected 1 to {} visible characters", jobs::MAX_KEY));
    jobs::read_key(text).map(Some).ok_or_else(wrong)
}

fn read_query(asked: proto::ListRequest) -> Result<ListQuery, Problem> {
    let state = |&number: &i32| {
        message::read_state(number).ok_or_else(|| Problem::query(format!("states: there is no state {number}")))
    };
    let time = |name, at: Option<prost_types::Timestamp>| at.map(|at| message::read_time(name, at)).transpose();
    Ok(ListQuery {
        before: Some(asked.cursor).filter(|text| !text.is_empty()).map(|text| list::read_cursor(&text)).transpose()?,
        states: asked.states.iter().map(state).collect::<Result<_, _>>()?,
        labels: asked.labels.into_iter().collect(),
        created_from: time("created_from", asked.created_from)?,
        created_to: time("created_to", asked.created_to)?,
        limit: if asked.limit == 0 { list::DEFAULT_LIMIT as usize } else { asked.limit as usize },
    })
}

/// A stream that breaks off at the call's deadline and when the service stops.
fn bounded<T: Send + 'static>(
    source: BoxStream<'static, Result<T, Problem>>,
    asked: Asked,
    stop: CancellationToken,
) -> Told<T> {
    let told = stream::unfold(Some((source, asked, stop)), |open| async move {
        let (mut source, asked, stop) = open?;
        let expired = async {
            match asked.deadline {
                Some(deadline) => tokio::time::sleep_until(deadline).await,
                None => std::future::pending().await,
            }
        };
        let next = tokio::select! {
            biased;
            () = stop.cancelled() => Some(Err(Problem::unavailable("stopping", "the service is stopping"))),
            () = expired => Some(Err(exceeded())),
            next = source.next() => next,
        };
        match next? {
            Ok(item) => Some((Ok(item), Some((source, asked, stop)))),
            Err(problem) => Some((Err(asked.refuse(problem)), None)),
        }
    });
    told.boxed()
}

/// Bytes that are read, and what they must come to.
struct Source {
    source: BoxStream<'static, Result<Bytes, Problem>>,
    buffer: BytesMut,
    /// Bytes that are not read yet.
    left: u64,
    /// What they hash to, where they are the whole.
    hash: Option<(Sha256, [u8; 32])>,
}

/// The bytes in pieces of one size. Ends with an error unless it has told all of them, and the whole by its hash: the last piece is
/// only told once that is sure.
fn pieces(source: Source) -> BoxStream<'static, Result<Bytes, Problem>> {
    let pieces = stream::unfold(Some(source), |open| async move {
        let mut open = open?;
        match open.next().await {
            Ok(piece) if piece.is_empty() => None,
            Ok(piece) => Some((Ok(piece), Some(open))),
            Err(problem) => Some((Err(problem), None)),
        }
    });
    pieces.boxed()
}

impl Source {
    /// The next piece; an empty one at the end.
    async fn next(&mut self) -> Result<Bytes, Problem> {
        while self.buffer.len() < PIECE && self.left > 0 {
            let Some(bytes) = self.source.next().await.transpose()? else { return Err(broken("too few")) };
            self.left = self.left.checked_sub(bytes.len() as u64).ok_or_else(|| broken("too many"))?;
            if let Some((hash, _)) = &mut self.hash {
                hash.update(&bytes);
            }
            self.buffer.extend_from_slice(&bytes);
        }
        if self.left == 0
            && let Some((hash, expected)) = self.hash.take()
            && hash.finalize()[..] != expected
        {
            return Err(broken("other"));
        }
        Ok(self.buffer.split_to(PIECE.min(self.buffer.len())).freeze())
    }
}

fn broken(found: &str) -> Problem {
    tracing::error!("an output is damaged: the store has {found} bytes than the record says");
    Problem::internal()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn source(parts: &[&'static [u8]], left: u64, whole: &[u8]) -> Source {
        let parts: Vec<Result<Bytes, Problem>> = parts.iter().map(|part| Ok(Bytes::from_static(part))).collect();
        let hash = Some((Sha256::new(), Sha256::digest(whole).into()));
        Source { source: stream::iter(parts).boxed(), buffer: BytesMut::new(), left, hash }
    }

    async fn told(source: Source) -> (Vec<u8>, bool) {
        let (mut bytes, mut failed) = (Vec::new(), false);
        for piece in pieces(source).collect::<Vec<_>>().await {
            match piece {
                Ok(piece) => bytes.extend_from_slice(&piece),
                Err(_) => failed = true,
            }
        }
        (bytes, failed)
    }

    #[tokio::test]
    async fn a_download_is_whole_or_fails() {
        assert_eq!(told(source(&[b"hel", b"lo"], 5, b"hello")).await, (b"hello".to_vec(), false));
        for (parts, left) in [(&[&b"hel"[..]][..], 5), (&[b"hello", b"!"], 6), (&[b"hello there"], 5), (&[b"jello"], 5)]
        {
            let (bytes, failed) = told(source(parts, left, b"hello")).await;
            assert!(failed && bytes.len() < 5, "{parts:?}: {bytes:?}");
        }
    }

    #[tokio::test]
    async fn a_download_comes_in_pieces_of_one_size() {
        static LARGE: [u8; 3 * PIECE + 5] = [7; 3 * PIECE + 5];
        let sizes: Vec<usize> = pieces(source(&[&LARGE], LARGE.len() as u64, &LARGE))
            .map(|piece| piece.expect("whole").len())
            .collect()
            .await;
        assert_eq!(sizes, [PIECE, PIECE, PIECE, 5]);
    }

    #[tokio::test]
    async fn an_open_stream_breaks_off_when_the_service_stops_and_at_its_deadline() {
        let open = || stream::pending::<Result<(), Problem>>().boxed();
        let asked = |deadline| Asked { request_id: "r".to_owned(), deadline, caller: None };
        let stop = CancellationToken::new();
        stop.cancel();
        let stopped: Vec<_> = bounded(open(), asked(None), stop).collect().await;
        assert_eq!(
            stopped.iter().map(|end| end.as_ref().map_err(Status::code)).collect::<Vec<_>>(),
            [Err(tonic::Code::Unavailable)]
        );
        let late: Vec<_> = bounded(open(), asked(Some(Instant::now())), CancellationToken::new()).collect().await;
        assert_eq!(
            late.iter().map(|end| end.as_ref().map_err(Status::code)).collect::<Vec<_>>(),
            [Err(tonic::Code::DeadlineExceeded)]
        );
    }
}
