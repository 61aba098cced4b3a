//! `shrinkd healthcheck`: asks a service whether it is ready, with nothing but a socket, so that the smallest image has it.

use super::{BAD_USAGE, FAILED, fail};
use std::io::{Read, Write};
use std::net::{TcpStream, ToSocketAddrs};
use std::process::ExitCode;
use std::time::Duration;

/// Time for each of connecting, asking and answering.
const PATIENCE: Duration = Duration::from_secs(3);
/// Where readiness is told when the address names no path.
const DEFAULT_PATH: &str = "/readyz";

/// The status line of a service's answer.
pub(super) fn ask(url: &str) -> std::io::Result<String> {
    Target::parse(url).ok_or_else(|| std::io::Error::other("no address of a service"))?.ask()
}

/// Exits 0 when the answer is 200.
pub fn run(url: &str) -> ExitCode {
    let Some(target) = Target::parse(url) else {
        return fail(BAD_USAGE, &format!("expected http://host:port[/path], found {url:?}"));
    };
    match target.ask() {
        Ok(status) if status.split(' ').nth(1) == Some("200") => ExitCode::SUCCESS,
        Ok(status) => fail(FAILED, &format!("{url}: {status}")),
        Err(error) => fail(FAILED, &format!("{url}: {error}")),
    }
}

#[derive(Debug, PartialEq)]
struct Target<'a> {
    authority: &'a str,
    path: &'a str,
}

impl<'a> Target<'a> {
    fn parse(url: &'a str) -> Option<Self> {
        let rest = url.strip_prefix("http://")?;
        let (authority, path) = rest.split_at(rest.find('/').unwrap_or(rest.len()));
        let path = if path.len() <= 1 { DEFAULT_PATH } else { path };
        // nothing that could end the request line early
        let plain = |text: &str| !text.is_empty() && text.bytes().all(|b| b.is_ascii_graphic());
        (plain(authority) && plain(path)).then_some(Self { authority, path })
    }

    /// The status line of the answer.
    fn ask(&self) -> std::io::Result<String> {
        let port = self.authority.rsplit_once(':').is_some_and(|(_, p)| p.parse::<u16>().is_ok());
        let address = if port { self.authority.to_owned() } else { format!("{}:80", self.authority) };
        let address = address.to_socket_addrs()?.next().ok_or_else(|| std::io::Error::other("no such host"))?;
        let mut stream = TcpStream::connect_timeout(&address, PATIENCE)?;
        stream.set_read_timeout(Some(PATIENCE))?;
        stream.set_write_timeout(Some(PATIENCE))?;
        let request = format!("GET {} HTTP/1.1\r\nHost: {}\r\nConnection: close\r\n\r\n", self.path, self.authority);
        stream.write_all(request.as_bytes())?;
        // a status line is short; more is no answer of this service
        let mut line = [0u8; 256];
        let mut length = 0;
        while length < line.len() && !line[..length].contains(&b'\n') {
            match stream.read(&mut line[length..])? {
                0 => break,
                n => length += n,
            }
        }
        let text = String::from_utf8_lossy(&line[..length]);
        Ok(text.lines().next().unwrap_or("").trim().to_owned())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_address_may_name_a_path() {
        let target = |authority, path| Some(Target { authority, path });
        assert_eq!(Target::parse("http://127.0.0.1:8080"), target("127.0.0.1:8080", "/readyz"));
        assert_eq!(Target::parse("http://[::1]:8080/"), target("[::1]:8080", "/readyz"));
        assert_eq!(Target::parse("http://a/livez"), target("a", "/livez"));
        for wrong in ["https://a", "a:80", "http://", "http://a/b\r\nX: y"] {
            assert_eq!(Target::parse(wrong), None, "{wrong}");
        }
    }
}
