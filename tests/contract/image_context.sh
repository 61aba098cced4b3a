#!/usr/bin/env bash
# Whether the image can be built of what its Dockerfile copies: checks the program in a folder that holds nothing else.
# Usage: tests/contract/image_context.sh DOCKERFILE
set -euo pipefail
context="$(mktemp -d)"
trap 'rm -rf "$context"' EXIT
# the copies of the stage that builds it, each with its sources before its target
sed -n '/^FROM rust/,/^FROM .*nonroot/p' "$1" | grep '^COPY ' | grep -v -- '--from=' | while read -r _ paths; do
  read -ra words <<<"$paths"
  target="$context/${words[-1]}"
  for source in "${words[@]::${#words[@]}-1}"; do
    if [ -d "$source" ]; then mkdir -p "$target" && cp -r "$source/." "$target"; else mkdir -p "$(dirname "$target")" && cp "$source" "$target"; fi
  done
done
cargo check --release --locked --quiet --bin shrinkd --manifest-path "$context/Cargo.toml"
