#!/usr/bin/env python3
"""Runs the commands of Markdown pages and holds their output against what the pages say.

    python3 tests/contract/walk_docs.py PROGRAM docs/tutorial.md docs/how-to/*.md

Every block fenced as `sh` is pasted into a bash session, one session for each page, in an empty folder in which the repository's files
can be reached. `shrinkd`, `target/release/shrinkd` and `cargo run --release --` are PROGRAM; ports 8080 to 8089 and 4222 are free ones in
their place. A command that runs the service in the foreground is given to the background, as a reader gives it a terminal of its own. All
that a page started has ended when the page has.

A block fails when a command in it exits non-zero, or when it does not say what the `text` block behind it shows: every line in this
order, where `…` stands for anything. `sh no-check` is not run; `sh needs NAME …` is run where every NAME is a program on the path or a
module of this Python. Both are counted as skipped. A page ends at its first failure, because what follows builds on it.

Exits 0 when nothing failed, 1 when something did, 2 on bad usage. Needs bash and Python 3.9.
"""

import argparse
import dataclasses
import importlib.util
import os
import pathlib
import re
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
import urllib.error
import urllib.request

REPOSITORY = pathlib.Path(__file__).resolve().parents[2]
# folders of the repository that a page must not see, because it makes its own or has no use for them
HIDDEN = {"target", "shrinkd-data"}
PORTS = re.compile(r"\b(808\d|4222)\b")
COLOURS = re.compile(r"\x1b\[[0-9;]*m")
SERVES = re.compile(r"(?:cargo run --release -- |(?:\S*/)?shrinkd )serve\b(?!.*--help)")
# shown of a failed block
TAIL = 4000


@dataclasses.dataclass
class Block:
    line: int
    words: list
    text: str
    expected: str = ""

    def name(self):
        first = next((one for one in self.text.splitlines() if one.strip() and not one.lstrip().startswith("#")), "")
        return first if len(first) <= 90 else first[:87] + "..."


def blocks_of(markdown):
    """The `sh` blocks of a page, each with the `text` block that stands behind it."""
    blocks, fence, behind = [], None, False
    for number, line in enumerate(markdown.splitlines(), 1):
        if fence is None and line.startswith("```"):
            words = line[3:].split()
            fence = (number, words, [])
        elif fence is not None and line.rstrip() == "```":
            number, words, lines = fence
            text, kind, fence = "\n".join(lines) + "\n", words[0] if words else "", None
            if kind == "sh":
                blocks.append(Block(number, words[1:], text))
            elif kind == "text" and behind:
                blocks[-1].expected = text
            behind = kind == "sh"
        elif fence is not None:
            fence[2].append(line)
    return blocks


def pattern_of(line):
    """A line of expected output: `…` stands for anything within a line, a blank for any blanks."""
    parts = [r"\s+".join(re.escape(word) for word in part.split()) for part in line.split("…")]
    return re.compile(r"[^\n]*?".join(parts))


def missing(expected, output):
    """The first expected line that is not in the output behind those before it."""
    at = 0
    for line in expected.splitlines():
        if not line.strip(" …"):
            continue
        found = pattern_of(line).search(output, at)
        if not found:
            return line
        at = found.end()
    return None


def free_ports(count):
    """Ports that nothing listens at."""
    listeners = [socket.socket() for _ in range(count)]
    for one in listeners:
        one.bind(("127.0.0.1", 0))
    ports = [one.getsockname()[1] for one in listeners]
    for one in listeners:
        one.close()
    return ports


def is_there(name):
    return shutil.which(name) is not None or (name.isidentifier() and importlib.util.find_spec(name) is not None)


class Session:
    """A bash in a folder of its own."""

    def __init__(self, program, folder, timeout):
        self.folder, self.timeout, self.count, self.served = folder, timeout, 0, []
        names = [f"808{digit}" for digit in range(10)] + ["4222"]
        self.ports = dict(zip(names, map(str, free_ports(len(names)))))
        work, bin_, hidden = folder / "work", folder / "bin", folder / "blocks"
        for one in (work, bin_, hidden, work / "target/release"):
            one.mkdir(parents=True)
        for entry in REPOSITORY.iterdir():
            if entry.name not in HIDDEN and not entry.name.startswith("."):
                (work / entry.name).symlink_to(entry)
        self.put(bin_ / "shrinkd", f'exec "{program}" "$@"')
        self.put(bin_ / "cargo", f'[ "$1 $2 $3" = "run --release --" ] || {{ echo "not here: cargo $*" >&2; exit 2; }}\nshift 3; exec "{program}" "$@"')
        self.put(bin_ / "python3", f'exec "{sys.executable}" "$@"')
        (work / "target/release/shrinkd").symlink_to(program)
        environment = {name: value for name, value in os.environ.items() if not name.startswith("SHRINKD_")}
        environment.update(PATH=f"{bin_}:{environment['PATH']}", SHRINKD_LISTEN=f"127.0.0.1:{self.ports['8080']}", NO_COLOR="1")
        self.bash = subprocess.Popen(
            ["bash", "--noprofile", "--norc"], cwd=work, env=environment, text=True, start_new_session=True,
            stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )
        self.say('trap \'walk_code=$?; [ "$walk_status" != 0 ] || walk_status=$walk_code\' ERR; walk_status=0')

    @staticmethod
    def put(path, text):
        path.write_text(f"#!/bin/sh\n{text}\n")
        path.chmod(0o755)

    def say(self, command):
        self.bash.stdin.write(command + "\n")
        self.bash.stdin.flush()

    def here(self, text):
        return PORTS.sub(lambda found: self.ports[found.group()], text)

    def run(self, block):
        """What went wrong, or None, and what the block said."""
        self.count += 1
        base = self.folder / "blocks" / str(self.count)
        script, said, done = base.with_suffix(".sh"), base.with_suffix(".out"), base.with_suffix(".done")
        text, waits = self.here(block.text), False
        commands = text.rstrip().replace("\\\n", " ").splitlines()
        if any(SERVES.match(one.strip()) for one in commands):
            waits = True
            self.served.append(said)
            if SERVES.match(commands[-1].strip()) and not commands[-1].rstrip().endswith("&"):
                text = text.rstrip() + " &\n"
        script.write_text(text)
        self.say(f"walk_status=0; source {script} >{said} 2>&1 </dev/null; echo $walk_status >{done}.part; mv {done}.part {done}")
        ends = time.monotonic() + self.timeout
        output = lambda: COLOURS.sub("", said.read_text(errors="replace")) if said.exists() else ""
        while not done.exists():
            if self.bash.poll() is not None:
                return "ended the shell", output()
            if time.monotonic() > ends:
                return f"had not ended after {self.timeout} s", output()
            time.sleep(0.05)
        status = done.read_text().strip()
        if status != "0":
            return f"exited with {status}", output()
        expected = self.here(block.expected)
        while True:
            lacks = missing(expected, output())
            if lacks is None and (not waits or self.is_ready(text)):
                return None, output()
            # only what runs in the background has more to say
            if not waits or time.monotonic() > ends or self.bash.poll() is not None:
                why = "is not ready" if lacks is None else f"does not say: {lacks.strip()}"
                return why, output()
            time.sleep(0.2)

    def is_ready(self, text):
        """Whether every service that the block started is."""
        for port in re.findall(r"--listen \S*:(\d+)", text) or [self.ports["8080"]]:
            try:
                urllib.request.urlopen(f"http://127.0.0.1:{port}/readyz", timeout=5).close()
            except (OSError, urllib.error.HTTPError):
                return False
        return True

    def close(self):
        """Ends everything that the session started."""
        for number, patience in ((signal.SIGTERM, 10), (signal.SIGKILL, 10)):
            try:
                os.killpg(self.bash.pid, number)
            except ProcessLookupError:
                break
            ends = time.monotonic() + patience
            while time.monotonic() < ends:
                self.bash.poll()
                try:
                    os.killpg(self.bash.pid, 0)
                except ProcessLookupError:
                    break
                time.sleep(0.05)
        self.bash.wait()


def walk(page, program, timeout):
    """Counts (passed, failed, skipped) of a page."""
    passed = failed = skipped = 0
    blocks = blocks_of(page.read_text())
    with tempfile.TemporaryDirectory(prefix="walk-docs-") as folder:
        session = Session(program, pathlib.Path(folder), timeout)
        try:
            for index, block in enumerate(blocks):
                place = f"{page}:{block.line}"
                lacks = [name for name in block.words[1:] if not is_there(name)] if block.words[:1] == ["needs"] else []
                if block.words == ["no-check"] or lacks:
                    skipped += 1
                    print(f"skip {place} {block.name()}" + (f" (needs {', '.join(lacks)})" if lacks else ""), flush=True)
                    continue
                clock = time.monotonic()
                wrong, output = session.run(block)
                if wrong is None:
                    passed += 1
                    print(f"ok   {place} {block.name()} ({time.monotonic() - clock:.1f} s)", flush=True)
                    continue
                failed += 1
                print(f"FAIL {place} {wrong}", flush=True)
                print("  " + block.text.rstrip().replace("\n", "\n  "))
                print("--- said:\n" + output[-TAIL:].rstrip() + "\n---")
                for served in session.served:
                    print("--- the service said:\n" + COLOURS.sub("", served.read_text(errors="replace"))[-TAIL:].rstrip() + "\n---")
                left = len(blocks) - index - 1
                if left:
                    print(f"not run of {page}: {left} more", flush=True)
                break
        finally:
            session.close()
    return passed, failed, skipped


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("program", type=pathlib.Path, help="the program that is built")
    parser.add_argument("pages", type=pathlib.Path, nargs="+", help="Markdown pages")
    parser.add_argument("--timeout", type=float, default=300, help="seconds that a block may take (300)")
    arguments = parser.parse_args()
    program = arguments.program.resolve()
    if not os.access(program, os.X_OK):
        parser.error(f"{program} cannot be run")
    for page in arguments.pages:
        if not page.is_file():
            parser.error(f"{page} is no file")
    # a signal ends what was started, too
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))
    counts = [walk(page, program, arguments.timeout) for page in arguments.pages]
    passed, failed, skipped = map(sum, zip(*counts))
    print(f"{passed} passed, {failed} failed, {skipped} skipped")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
