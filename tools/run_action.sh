#!/usr/bin/env bash
# Run 'bevviz batch' as the GitHub Action does. The inputs are variables of the environment (see action.yml).
# The summary of the job, and summary.md, hold what the command prints. The exit status is that of the command.
set -uo pipefail
set -f # bevviz itself expands patterns
read -ra bags <<<"$BAGS"
read -ra arguments <<<"${ARGUMENTS:-}"
junit="$OUTPUT/bevviz.xml"
command=(bevviz batch "${bags[@]}" -o "$OUTPUT")
[ -z "${MODEL:-}" ] || command+=(--model "$MODEL")
case "${TRUTH:-}" in
    "") ;;
    own) command+=(--truth) ;;
    *) command+=(--truth "$TRUTH") ;;
esac
for limit in ${MINIMA:-}; do command+=(--min "$limit"); done
for limit in ${MAXIMA:-}; do command+=(--max "$limit"); done
[ -z "${MINIMA:-}${MAXIMA:-}" ] || command+=(--junit "$junit")
command+=("${arguments[@]}" --quiet)

mkdir -p "$OUTPUT"
"${command[@]}" >"$OUTPUT/summary.txt" 2>"$OUTPUT/errors.txt"
status=$?
cat "$OUTPUT/summary.txt" "$OUTPUT/errors.txt"
{
    [ "$status" = 0 ] && echo "### bevviz: passed" || echo "### bevviz: failed (exit status $status)"
    for part in "$OUTPUT/summary.txt" "$OUTPUT/errors.txt"; do
        [ ! -s "$part" ] || { echo; sed 's/^/    /' "$part"; } # an indented block: nothing in it is markup
    done
} >"$OUTPUT/summary.md"
rm "$OUTPUT/summary.txt" "$OUTPUT/errors.txt"
cat "$OUTPUT/summary.md" >>"${GITHUB_STEP_SUMMARY:-/dev/null}"
printf 'junit=%s\npage=%s\n' "$junit" "$OUTPUT/summary.html" >>"${GITHUB_OUTPUT:-/dev/null}"
exit "$status"
