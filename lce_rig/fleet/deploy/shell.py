"""What runs at a target: POSIX shell, the same for a folder of this computer and over ssh.

A target is a folder:

    current -> releases/20261123T021501Z-ab12cd34      what robot software reads
    releases/20261123T021501Z-ab12cd34/                a set of files, never changed
    deployments.log                                    one JSON object a line, for people
    .pending                                           the release whose command has not succeeded yet
    .new-XXXX/                                         a set that is being written

A set is written aside and becomes current by one rename of the link. Whatever is interrupted leaves `current`
as it was or as it will be, and remains that the next deployment removes. There is no lock while files are
written: who finds another set current than at the beginning is refused. A set written by another deployment
at the same time is removed with the remains; that deployment is refused, too.
"""

UNWRITABLE, NO_LINK, LOCKED, CHANGED, NO_RELEASE = 73, 74, 75, 76, 77
"""Exit codes of the scripts."""
SAYS = "lce-rig "
"""What each line of their output begins with; a login shell may print lines of its own."""
RECORD, USED = ".deployed.json", ".used"
"""Files of a release that are not of the set."""

_COMMON = rf"""
set -u
unset CDPATH
p=$1
die() {{ echo "$2" >&2; exit "$1"; }}
enter() {{ cd -- "$p" || die {UNWRITABLE} "$p cannot be entered"; }}
current() {{ c=$(cd current 2>/dev/null && pwd -P); printf '%s' "${{c##*/}}"; }}
flush() {{ sync -f "$1" 2>/dev/null || sync; }}
# The kernel drops the lock of flock with its holder. Without flock a folder is the lock, and one whose holder
# is dead, or of before the last start of the computer, is taken over.
lock() {{
  if command -v flock >/dev/null 2>&1; then
    exec 9>.lock || die {UNWRITABLE} "$p cannot be written"
    flock -w 10 9 || die {LOCKED} "another deployment is at work"
    return
  fi
  me="$(cat /proc/sys/kernel/random/boot_id 2>/dev/null) $$" tries=0
  until mkdir .lock.d 2>/dev/null; do
    [ -w . ] || die {UNWRITABLE} "$p cannot be written"
    owner=$(cat .lock.d/owner 2>/dev/null)
    if [ "${{owner% *}}" = "${{me% *}}" ] && kill -0 "${{owner##* }}" 2>/dev/null; then :
    elif [ "$tries" -ge 2 ]; then mv .lock.d ".stale-$$" 2>/dev/null && rm -rf ".stale-$$"; fi
    tries=$((tries + 1))
    [ "$tries" -le 10 ] || die {LOCKED} "another deployment is at work"
    sleep 1
  done
  trap 'rm -rf .lock.d' EXIT
  printf '%s\n' "$me" >.lock.d/owner
}}
# Removes what was never current; a rename first, so that nothing half removed looks whole.
drop() {{ mv -- "$1" ".new-old-$$" && rm -rf ".new-old-$$"; }}
tidy() {{
  rm -rf .new-* .swap-* .stale-*
  c=$(current)
  for r in releases/*/; do
    [ -d "$r" ] || continue
    r=${{r%/}}
    if [ "${{r##*/}}" = "$c" ]; then : >>"$r/{USED}"; fi
    [ -e "$r/{USED}" ] || drop "$r"
  done
}}
state() {{
  echo '{SAYS}current '"$(current)"
  [ -e .pending ] && echo '{SAYS}pending '"$(cat .pending)"
  for r in releases/*/; do
    r=${{r%/}}
    [ -f "$r/{RECORD}" ] || continue
    [ -e "$r/{USED}" ] || [ "${{r##*/}}" = "$(current)" ] || continue
    printf '{SAYS}release %s ' "${{r##*/}}"
    cat "$r/{RECORD}"
  done
  return 0
}}
"""

STATE = rf"""{_COMMON}
main() {{
  [ -d "$p" ] || {{ echo '{SAYS}current '; return 0; }}
  enter
  state
}}
main
"""
"""Print what is there: PATH."""

PREPARE = rf"""{_COMMON}
main() {{
  mkdir -p -- "$p" || die {UNWRITABLE} "$p cannot be made"
  enter
  if [ -e current ] && ! [ -L current ]; then die {NO_LINK} "$p/current is no link"; fi
  lock
  tidy
  mkdir -p releases || die {UNWRITABLE} "$p cannot be written"
  state
}}
main
"""
"""Make the folder, remove what was left behind, and print what is there: PATH."""

COMMIT = rf"""{_COMMON}
# What is begun is finished, also if whoever asked for it is gone.
trap '' HUP INT TERM PIPE
main() {{
  enter
  lock
  [ "$(current)" = "$expected" ] || die {CHANGED} "$(current) is current"
  if [ -n "$id" ]; then
    [ -d ".new-$id" ] || die {CHANGED} "the new files are gone"
    flush ".new-$id"
    mv -- ".new-$id" "releases/$name" || die {UNWRITABLE} "$p/releases cannot be written"
  fi
  [ -d "releases/$name" ] || die {NO_RELEASE} "there is no release $name"
  if [ -n "$pending" ]; then
    printf '%s\n' "$name" >.pending || die {UNWRITABLE} "$p cannot be written"
  fi
  # Given a folder, mv renames into it: one rename of a link over a link.
  mkdir ".swap-$$" && ln -s "releases/$name" ".swap-$$/current" && mv -f ".swap-$$/current" . ||
    die {UNWRITABLE} "$p cannot be written"
  printf '%s\n' "$line" >>deployments.log
  tidy
  n=0
  for r in $(ls -r releases); do
    n=$((n + 1))
    if [ "$n" -gt "$keep" ] && [ "$r" != "$name" ] && [ "$r" != "$expected" ]; then drop "releases/$r"; fi
  done
  flush .
}}
id=$2 name=$3 expected=$4 keep=$5 pending=$6 line=$7
main
"""
"""Make a release current: PATH, ID of new files or "", RELEASE, EXPECTED current one, KEEP, PENDING, LINE."""

RUN = rf"""{_COMMON}
main() {{
  enter
  ( cd current && exec sh -c "$command" ) </dev/null 2>&1
  code=$?
  if [ "$code" -eq 0 ] && [ "$(cat .pending 2>/dev/null)" = "$name" ]; then rm -f .pending; fi
  printf '{{"action": "run", "release": "%s", "exit": %s}}\n' "$name" "$code" >>deployments.log
  echo '{SAYS}exit '"$code"
}}
name=$2 command=$3
main
"""
"""Run a command in the current set: PATH, RELEASE, COMMAND. The last line of its output is the exit code."""
