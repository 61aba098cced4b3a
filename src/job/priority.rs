//! Threads that compute give way to those that answer.
//!
//! Where all cores compute, a thread that answers a request would wait for its turn behind them. So whoever computes says that it is
//! not in a hurry: the cores are still all its own while nothing else is to be done.

/// How far computing stands back, on the scale of nice(2) from 0 to 19: at 5 a thread that answers weighs three times as much.
const NICENESS: i32 = 5;

/// Makes the calling thread give way, for good: only a privileged process could take it back.
pub fn give_way() {
    #[cfg(target_os = "linux")]
    if let Err(error) = rustix::process::setpriority_process(Some(rustix::thread::gettid()), NICENESS) {
        tracing::debug!(%error, "a thread keeps its priority");
    }
}

/// Runs work on a thread of its own that gives way, with the result once it is there; `None` when it panicked.
pub async fn compute<T: Send + 'static>(work: impl FnOnce() -> T + Send + 'static) -> Option<T> {
    let (done, result) = tokio::sync::oneshot::channel();
    let thread = std::thread::Builder::new().name("job".to_owned()).spawn(move || {
        give_way();
        // nobody waits any more when the worker was stopped
        let _ = done.send(work());
    });
    if let Err(error) = thread {
        tracing::error!(%error, "no thread can be started");
    }
    result.await.ok()
}

#[cfg(all(test, target_os = "linux"))]
mod tests {
    use super::*;

    #[tokio::test]
    async fn what_computes_gives_way_and_nothing_else_does() {
        let own = || rustix::process::getpriority_process(Some(rustix::thread::gettid())).expect("asks");
        let before = own();
        assert_eq!(compute(own).await, Some(before.max(NICENESS)));
        assert_eq!(own(), before);
        assert_eq!(compute(|| panic!("as jobs do")).await, None::<()>);
    }
}
