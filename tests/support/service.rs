//! Processes of the service that examples start: each with a port that stays its own, killed when its handle is dropped.

use std::net::TcpListener;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};

/// The service, where `--program` names no other.
pub const PROGRAM: &str = "target/release/shrinkd";

/// What an example may come to.
pub type Outcome<T> = Result<T, Box<dyn std::error::Error + Send + Sync>>;

/// What follows an option on the command line.
pub fn option(name: &str) -> Option<String> {
    std::env::args().skip_while(|argument| argument != name).nth(1)
}

/// The program that is to be started.
pub fn program() -> PathBuf {
    PathBuf::from(option("--program").unwrap_or_else(|| PROGRAM.to_owned()))
}

/// A process of the service.
pub struct Node {
    child: Child,
    port: u16,
    program: PathBuf,
    folder: PathBuf,
    variables: Vec<(&'static str, String)>,
}

impl Node {
    /// Starts a process in a folder, which nodes of a cluster share, with these variables.
    pub fn start(program: &Path, folder: &Path, variables: &[(&'static str, String)]) -> Outcome<Self> {
        let port = TcpListener::bind("127.0.0.1:0")?.local_addr()?.port();
        let (program, folder, variables) = (program.to_owned(), folder.to_owned(), variables.to_vec());
        let child = Self::spawn(&program, &folder, &variables, port)?;
        Ok(Self { child, port, program, folder, variables })
    }

    fn spawn(program: &Path, folder: &Path, variables: &[(&'static str, String)], port: u16) -> Outcome<Child> {
        let mut command = Command::new(program);
        command.args(["serve", "--listen", &format!("127.0.0.1:{port}"), "--data"]).arg(folder);
        command.env("SHRINKD_LOG__FILTER", "error").envs(variables.iter().map(|(name, value)| (name, value)));
        Ok(command.stdout(Stdio::null()).stderr(Stdio::null()).spawn()?)
    }

    /// Where it listens.
    pub fn url(&self) -> String {
        format!("http://127.0.0.1:{}", self.port)
    }

    /// Its number among the processes of the machine.
    #[allow(dead_code, reason = "not every example that includes this file needs it")]
    pub fn id(&self) -> u32 {
        self.child.id()
    }

    /// Kills it at once, as `kill -9` does.
    pub fn kill(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }

    /// Kills it and starts it again.
    #[allow(dead_code, reason = "not every example that includes this file needs it")]
    pub fn restart(&mut self) -> Outcome<()> {
        self.kill();
        self.child = Self::spawn(&self.program, &self.folder, &self.variables, self.port)?;
        Ok(())
    }

    /// Starts it again if it has ended by itself, as a service manager would.
    #[allow(dead_code, reason = "not every example that includes this file needs it")]
    pub fn revive(&mut self) -> Outcome<()> {
        if self.child.try_wait()?.is_some() { self.restart() } else { Ok(()) }
    }

    /// Sends it a signal, such as `-STOP`.
    #[allow(dead_code, reason = "not every example that includes this file needs it")]
    pub fn signal(&self, name: &str) {
        let _ = Command::new("kill").args([name, &self.child.id().to_string()]).status();
    }
}

impl Drop for Node {
    fn drop(&mut self) {
        self.kill();
    }
}
