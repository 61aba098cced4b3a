//! The ids of jobs that wait, in the order in which they began to wait.
//!
//! An id in the queue is a hint and no promise: the record says whether the job waits. So an id may be there twice in time,
//! or late, and one that is missing is put back by the [sweeper](super::sweeper). A job that comes back to the queue comes
//! back at its end.

use super::layout::{Layout, Name};
use super::link::{Expect, Link, failed};
use crate::engine::EngineError;
use async_nats::jetstream::AckKind;
use async_nats::jetstream::Message;
use async_nats::jetstream::consumer::PullConsumer;
use bytes::Bytes;
use futures::StreamExt;
use std::time::Duration;

/// How long the server may keep a request for a job; one that it lost is asked again after this time and a little more.
const REQUEST: Duration = Duration::from_secs(5);

/// The queue.
pub(super) struct Queue {
    link: Link,
    layout: Layout,
    workers: PullConsumer,
}

/// An id that was taken from the queue. It comes back to it unless it is [settled](Ticket::settle).
pub(super) struct Ticket {
    pub name: Name,
    message: Message,
}

impl Queue {
    pub(super) async fn open(link: Link, layout: Layout) -> Result<Self, EngineError> {
        let workers = layout.workers().await?;
        Ok(Self { link, layout, workers })
    }

    /// Puts a job in the queue; one that is there moves to its end.
    pub(super) async fn push(&self, name: &Name) -> Result<(), EngineError> {
        self.link.store(&self.layout.work, self.layout.work(name), Bytes::new(), Expect::Any).await.map(|_| ())
    }

    /// Up to `slots` ids that wait now, oldest first.
    pub(super) async fn waiting(&self, slots: usize) -> Result<Vec<Ticket>, EngineError> {
        let batch = self.workers.fetch().max_messages(slots).messages().await;
        let batch = batch.map_err(|e| failed("the queue")(e.into()))?;
        tickets(batch.collect().await).await
    }

    /// The next id that comes within `wait`, or earlier nothing.
    pub(super) async fn next(&self, wait: Duration) -> Result<Vec<Ticket>, EngineError> {
        let expires = wait.clamp(Duration::from_millis(1), REQUEST);
        let batch = self.workers.batch().max_messages(1).expires(expires).messages().await;
        let batch = batch.map_err(|e| failed("the queue")(e.into()))?;
        let came = tokio::time::timeout(expires + Duration::from_secs(1), batch.collect());
        // a request that was lost with a connection is no error
        tickets(came.await.unwrap_or_default()).await
    }

    /// Makes the queue's consumer again, should somebody have removed it.
    pub(super) async fn mend(&self) -> Result<(), EngineError> {
        self.layout.workers().await.map(|_| ())
    }
}

async fn tickets(messages: Vec<Result<Message, async_nats::Error>>) -> Result<Vec<Ticket>, EngineError> {
    let mut tickets = Vec::new();
    for message in messages {
        let message = message.map_err(failed("the queue"))?;
        match Layout::name_of(&message.subject) {
            Some(name) => tickets.push(Ticket { name, message }),
            // not one of ours: nobody could do anything with it
            None => {
                let _ = message.ack_with(AckKind::Term).await;
            }
        }
    }
    Ok(tickets)
}

impl Ticket {
    /// Takes the id out of the queue for good, because the record says what becomes of the job.
    pub(super) async fn settle(&self) {
        if let Err(error) = self.message.double_ack().await {
            // it comes back, and is settled then
            tracing::warn!(job.id = %self.name.id, %error, "an id could not be taken from the queue");
        }
    }
}
