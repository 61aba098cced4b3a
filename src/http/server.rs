//! Connections: accepted, spoken with over HTTP/1.1 or HTTP/2, and let go when the service stops or nothing comes.
//!
//! Whoever connects and sends nothing costs a file for a minute and no longer: heads have to come within a minute, peers of HTTP/2 have to
//! answer a ping. Bodies have their own [limits](super::body).

use axum::Router;
use hyper_util::rt::{TokioExecutor, TokioIo, TokioTimer};
use hyper_util::server::conn::auto;
use hyper_util::server::graceful::GracefulShutdown;
use hyper_util::service::TowerToHyperService;
use std::time::Duration;
use tokio::net::TcpListener;
use tokio_util::sync::CancellationToken;

/// Time for the head of a request, from the moment at which the connection waits for it.
const HEAD: Duration = Duration::from_secs(60);
/// Time between two pings of a connection of HTTP/2, and time for the answer.
const PING: Duration = Duration::from_secs(30);
/// Pause after a connection could not be accepted, because files have run out.
const PAUSE: Duration = Duration::from_millis(200);

/// Serves until `close` is raised, and then until every request that is under way has its answer. Whoever asks between the stop of the
/// service and that moment hears that it is stopping.
pub async fn serve(listener: TcpListener, router: Router, close: CancellationToken) {
    let mut builder = auto::Builder::new(TokioExecutor::new());
    builder.http1().timer(TokioTimer::new()).header_read_timeout(HEAD);
    builder.http2().timer(TokioTimer::new()).keep_alive_interval(PING).keep_alive_timeout(PING);
    let open = GracefulShutdown::new();
    loop {
        let accepted = tokio::select! {
            () = close.cancelled() => break,
            accepted = listener.accept() => accepted,
        };
        let stream = match accepted {
            Ok((stream, _)) => stream,
            Err(error) => {
                tracing::warn!(%error, "a connection could not be accepted");
                tokio::time::sleep(PAUSE).await;
                continue;
            }
        };
        // events are small and must not wait for more
        if let Err(error) = stream.set_nodelay(true) {
            tracing::debug!(%error, "a connection is gone already");
        }
        let service = TowerToHyperService::new(router.clone());
        let connection = builder.serve_connection_with_upgrades(TokioIo::new(stream), service).into_owned();
        let connection = open.watch(connection);
        tokio::spawn(async move {
            if let Err(error) = connection.await {
                tracing::debug!(error, "a connection broke off");
            }
        });
    }
    drop(listener);
    open.shutdown().await;
}

#[cfg(test)]
mod tests {
    use super::*;
    use axum::routing::get;
    use tokio::io::{AsyncReadExt, AsyncWriteExt};
    use tokio::net::TcpStream;

    #[tokio::test(start_paused = true)]
    async fn whoever_sends_no_head_is_let_go_and_an_answer_may_take_longer() {
        let listener = TcpListener::bind("127.0.0.1:0").await.expect("a port");
        let (address, stop) = (listener.local_addr().expect("an address"), CancellationToken::new());
        let slow = || async {
            tokio::time::sleep(3 * HEAD).await;
            "late"
        };
        let server = tokio::spawn(serve(listener, Router::new().route("/", get(slow)), stop.clone()));
        let mut silent = TcpStream::connect(address).await.expect("connects");
        silent.write_all(b"GET / HTTP/1.1\r\nhost: ").await.expect("sends");
        let mut asking = TcpStream::connect(address).await.expect("connects");
        asking.write_all(b"GET / HTTP/1.1\r\nhost: a\r\nconnection: close\r\n\r\n").await.expect("sends");
        let mut answer = String::new();
        // whether it says so or not, the connection is closed
        let _ = silent.read_to_string(&mut answer).await;
        assert!(!answer.contains("200 OK"), "{answer}");
        stop.cancel();
        let mut answer = String::new();
        asking.read_to_string(&mut answer).await.expect("is answered");
        assert!(answer.starts_with("HTTP/1.1 200 OK") && answer.ends_with("late"), "{answer}");
        server.await.expect("stops");
    }
}
