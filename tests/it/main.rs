//! Tests of the whole program from outside: the real binary, over HTTP and on the command line.

mod app;
mod backup;
mod bucket;
mod certify;
mod cli;
mod client;
mod cluster;
mod cluster_backup;
mod collecting;
mod conditional;
mod contract;
mod control;
mod curves;
mod evaluate;
mod faults;
mod fit;
mod grpc;
mod issuer;
mod losses;
mod metrics;
mod monitoring;
mod quotas;
mod reading;
mod refusals;
mod relaxed;
#[path = "../support/bucket.rs"]
mod s3;
mod sensitivity;
mod starts;
mod tenants;
mod traces;
mod waiting;
mod walk;
mod warm;
mod webhooks;
mod weight;
