#!/usr/bin/env bash
# Holds a running service to its description with schemathesis: every phase, every check, the links followed.
#   tests/contract/schemathesis.sh PROGRAM FOLDER
# FOLDER keeps schemathesis between runs. Fails when a check does.
set -euo pipefail
program="$(realpath "$1")" && mkdir -p "$2" && folder="$(realpath "$2")" && here="$(realpath "$(dirname "$0")")"
version=4.32.5
tool="$folder/schemathesis-$version"

"$tool/bin/st" --version >/dev/null 2>&1 || {
  python="$(command -v python3 || command -v python)"
  "$python" -c 'import venv, ensurepip' 2>/dev/null || { apt-get update -qq && apt-get install -y -qq python3-venv; }
  "$python" -m venv --clear "$tool"
  "$tool/bin/pip" install --quiet --disable-pip-version-check "schemathesis==$version"
}

work="$(mktemp -d)"
stop() {
  # the one that cancels first, so that it does not ask a service that is gone
  [ -z "${canceler:-}" ] || kill "$canceler" 2>/dev/null || true
  [ -z "${service:-}" ] || kill "$service" 2>/dev/null || true
  wait 2>/dev/null || true
  rm -rf "$work"
}
trap stop EXIT

# few bytes, so that limits are met; a port that is free now
port="$(python3 -c 'import socket; s = socket.socket(); s.bind(("127.0.0.1", 0)); print(s.getsockname()[1])')"
url="http://127.0.0.1:$port"
SHRINKD_LOG__FILTER=error SHRINKD_LIMITS__BODY_BYTES=65536 SHRINKD_LIMITS__INPUT_BYTES=262144 \
  "$program" serve --listen "127.0.0.1:$port" --data "$work/data" &
service=$!
for _ in $(seq 300); do "$program" healthcheck "$url" 2>/dev/null && break; sleep 0.1; done
"$program" healthcheck "$url"

# generated jobs may take long, and their streams last as long as they do: each is given a second or two
python3 - "$url" <<'PYTHON' &
import json, sys, time, urllib.request
url, seen = sys.argv[1], set()
while True:
    try:
        with urllib.request.urlopen(f"{url}/v1/jobs?state=queued&state=running&limit=200") as answer:
            jobs = {job["id"] for job in json.load(answer)["jobs"]}
        for job in jobs & seen:
            urllib.request.urlopen(urllib.request.Request(f"{url}/v1/jobs/{job}/cancel", method="POST")).close()
        seen = jobs
    except OSError:
        pass  # forgotten meanwhile
    time.sleep(1)
PYTHON
canceler=$!

cd "$work"
# a scene holds scenes, so the least example of a job is large; that is no fault of the service, and generating goes on all the same
"$tool/bin/st" --config-file "$here/schemathesis.toml" run "$url/openapi.json" \
  --suppress-health-check large_base_example --phases examples,coverage,fuzzing,stateful --checks all --mode all --seed 1 --max-examples "${SCHEMATHESIS_EXAMPLES:-40}" \
  --generation-deterministic --continue-on-failure --request-timeout 90 --no-color
"$program" healthcheck "$url"
