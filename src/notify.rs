//! Tells the ends of jobs to whoever the jobs name (`webhook`), after the Standard Webhooks specification.
//!
//! Guarantees: the end of a job is told at least once, by whichever node is there, unless the receiver says that it is gone (410),
//! fails for [`schedule`] long, or the job is forgotten before; every attempt has the same `webhook-id`. A request goes only to
//! addresses that [`network`] permits, looked up and connected to in one step; it follows no redirect, uses no proxy, and nothing of an
//! answer is read but its status and `Retry-After`.
//! Not guaranteed: that the end is told only once, and in the order in which jobs end. What a receiver answers is no secret of the
//! service: it goes to the log only, and never to who submitted the job.

pub mod courier;
pub mod network;
pub mod payload;
pub mod schedule;
pub mod signature;
pub mod target;
