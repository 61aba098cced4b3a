//! Ctrl-C on the command line: the first raises the cancel token, so that what is done can be written; the second ends the
//! process.

use crate::settings::CancelToken;
use tokio::signal::unix::{SignalKind, signal};

/// Exit code of a process that a second signal ended: 128 and the number of SIGINT, as shells say it.
const KILLED: i32 = 130;

/// Raises the token on SIGINT or SIGTERM, from a thread of its own that lasts as long as the process.
pub fn raise_on_signal(cancel: &CancelToken) -> std::io::Result<()> {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_io().build()?;
    let (mut interrupt, mut terminate) = {
        let _inside = runtime.enter();
        (signal(SignalKind::interrupt())?, signal(SignalKind::terminate())?)
    };
    let cancel = cancel.clone();
    std::thread::Builder::new().name("signals".to_owned()).spawn(move || {
        runtime.block_on(async {
            for raised in 0.. {
                tokio::select! {
                    _ = interrupt.recv() => {}
                    _ = terminate.recv() => {}
                }
                if raised > 0 {
                    std::process::exit(KILLED);
                }
                eprintln!("shrinkd: stopping; once more to end at once");
                cancel.cancel();
            }
        });
    })?;
    Ok(())
}
