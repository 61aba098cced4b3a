#!/bin/sh
# The walk of docs/api-walk.md as one script: submits a job, follows it, downloads what it made, uploads an input, and is refused once.
#
#     examples/walk.sh [ADDRESS] [FOLDER]
#
# ADDRESS is the service's, http://127.0.0.1:8080 when nothing is said; shape.glb and shape.png are left in FOLDER (shrinkd-walk). A service
# that asks who its callers are gets the key in SHRINKD_KEY. Needs curl and sed. When something fails, says what the service said and exits 1.
set -eu

address="${1:-http://127.0.0.1:8080}"
address="${address%/}"
folder="${2:-shrinkd-walk}"
scratch="$folder/.walk.$$"
mkdir -p "$folder"
mkdir -m 700 "$scratch"
trap 'rm -rf "$scratch"' EXIT
trap 'exit 130' INT TERM

say() { printf '\n== %s\n' "$*"; }

fail() {
  printf 'walk: %s\n' "$*" >&2
  exit 1
}

# member NAME FILE: the first text of that name in a line of JSON
mark="$(printf '\001')"
member() {
  sed -nE 's/"'"$1"'":"(([^"\\]|\\.)*)".*/'"$mark"'\1/; s/^.*'"$mark"'//p' "$2" | sed -E 's/\\(["\\])/\1/g'
}

# told FILE: what a problem document says, and every fault with its place
told() {
  code="$(member code "$1")"
  [ -n "$code" ] || { sed -n 1p "$1"; return; }
  printf '%s: %s\n' "$code" "$(member detail "$1")"
  sed 's/{"pointer":"/\
/g' "$1" | sed -nE '2,$ s/^([^"]*)","code":"[^"]*","detail":"(([^"\\]|\\.)*)".*/  \1: \2/p' | sed -E 's/\\(["\\])/\1/g'
}

# send PATH [OPTION...]: an answer into the files head and body; prints its status
send() {
  path="$1"
  shift
  : >"$scratch/body"
  curl -sS -K "$scratch/config" -D "$scratch/head" -o "$scratch/body" -w '%{http_code}' "$@" "$address$path" ||
    fail "no answer from $address$path"
}

# ask PATH [OPTION...]: the same, and only a success will do
ask() {
  status="$(send "$@")"
  case "$status" in
    2??) ;;
    *) fail "$1 was answered $status $(told "$scratch/body")" ;;
  esac
}

# header NAME: a field of the last answer
header() { sed -nE "s/^$1: ([^[:cntrl:]]*).*/\1/p" "$scratch/head"; }

# ended JOB: waits for a job's end; anything but a success ends the walk
ended() {
  while :; do
    ask "/v1/jobs/$1?wait=30"
    state="$(member state "$scratch/body")"
    case "$state" in
      succeeded) return ;;
      failed)
        sed 's/.*"problem":{/{/' "$scratch/body" >"$scratch/problem"
        fail "job $1 failed: $(told "$scratch/problem")"
        ;;
      canceled) fail "job $1 was canceled" ;;
    esac
  done
}

# download JOB NAME FILE: an output, checked against the job's record (the file body)
download() {
  sed 's/.*{"name":"'"$2"'"/{"name":"'"$2"'"/' "$scratch/body" >"$scratch/output"
  bytes="$(sed -nE 's/^[^}]*"bytes":([0-9]+).*/\1/p' "$scratch/output")"
  sha256="$(member sha256 "$scratch/output")"
  [ -n "$bytes" ] || fail "job $1 has no output $2"
  curl -fsS -K "$scratch/config" --retry 3 -o "$3" "$address/v1/jobs/$1/outputs/$2" || fail "output $2 did not come"
  [ "$(($(wc -c <"$3")))" -eq "$bytes" ] || fail "$3 is not $bytes bytes long"
  if command -v sha256sum >/dev/null; then
    printf '%s  %s\n' "$sha256" "$3" | sha256sum -c - >/dev/null 2>&1 || fail "$3 has not the SHA-256 of the record"
  fi
  printf '%s: %s bytes, SHA-256 %s\n' "$3" "$bytes" "$sha256"
}

# the key goes into a file, because a command line is for everybody to see
: >"$scratch/config"
[ -z "${SHRINKD_KEY:-}" ] || printf 'header = "authorization: Bearer %s"\n' "$SHRINKD_KEY" >"$scratch/config"

say "submit: a scene is a good job; sent again with the same key it is the same job"
key="walk-$$-$(date +%s)"
cat >"$scratch/job.json" <<'JSON'
{"field": {"scene": {"smooth_union": {"k": 0.1, "of": [
   {"sphere": {"radius": 0.45}},
   {"translate": {"by": [0.35, 0, 0.3], "of": {"sphere": {"radius": 0.25}}}}]}}},
 "outputs": ["glb", "preview", "report"], "labels": {"project": "walk"}}
JSON
submit() { ask /v1/jobs -H 'content-type: application/json' -H "idempotency-key: $key" --data-binary "@$scratch/job.json"; }
submit
job="$(member id "$scratch/body")"
echo "$status, job $job at $(header location)"
submit
[ "$(member id "$scratch/body")" = "$job" ] || fail "the same key made two jobs"
echo "$status again, replayed: $(header idempotent-replayed)"

say "follow: what happens as it happens, from the first event on"
# whole NAME: the number of the last event that came whole; a frame ends with an empty line
whole() { sed -nE -e '/^id: /{s/^id: //;h;}' -e '/^$/{x;/./p;}' "$scratch/stream" | sed -n '$p'; }
last=0
fruitless=0
while :; do
  rm -f "$scratch/broken"
  {
    curl -sSN -f -K "$scratch/config" -H "last-event-id: $last" "$address/v1/jobs/$job/events" || : >"$scratch/broken"
  } | tee "$scratch/stream" | sed -E 's/^(.{110}).*/\1 .../'
  number="$(whole)"
  [ -z "$number" ] || last="$number"
  [ -e "$scratch/broken" ] || [ -z "$(sed -n '/^event: done/p' "$scratch/stream")" ] || break
  # taken up behind the last event, and given up when nothing comes any more
  printf '\n-- cut off: on behind event %s\n' "$last"
  [ -z "$number" ] && fruitless="$((fruitless + 1))" || fruitless=0
  [ "$fruitless" -lt 5 ] || fail "the events of job $job do not come"
  sleep 2
done
ask "/v1/jobs/$job/events" -H "last-event-id: $last"
[ "$status" = 204 ] || fail "a reader that has seen everything was answered $status"
echo "$last events; whoever has seen them is answered $status and need not come back"

say "wait, and look at the figures"
ended "$job"
number() { sed -nE 's/.*"'"$1"'":([0-9.]+).*/\1/p' "$scratch/body"; }
echo "$(number vertices) vertices, normal consistency $(number normal_consistency)"

say "download, checked against the job's record"
download "$job" glb "$folder/shape.glb"
download "$job" preview "$folder/shape.png"

say "upload: a scene, a network, a mesh or a grid is named by its hash, and a job names it"
echo '{"sphere": {"radius": 0.6}}' >"$scratch/sphere.json"
ask /v1/inputs --data-binary "@$scratch/sphere.json"
input="$(member id "$scratch/body")"
echo "$status, $input"
request="{\"field\": {\"input\": \"$input\"}, \"shrink\": {\"lattice\": {\"octahedral\": {\"n\": 16}}}, \"outputs\": [\"report\"]}"
ask /v1/jobs -H 'content-type: application/json' -H 'prefer: wait=60' -d "$request"
ended "$(member id "$scratch/body")"
echo "job $(member id "$scratch/body") $(member state "$scratch/body")"

say "a wrong request is told what is wrong, and where"
status="$(send /v1/jobs -H 'content-type: application/json' -d '{"field": {"scene": {"sphere": {"radios": 1}}}}')"
[ "$status" = 422 ] || fail "a wrong request was answered $status"
echo "$status $(told "$scratch/body")"

say "done: $folder/shape.glb and $folder/shape.png"
