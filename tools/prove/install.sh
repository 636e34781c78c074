#!/bin/sh
# Install what `make prove` needs, on Debian and Ubuntu; where that is not possible, name it.
set -eu

missing=
command -v frama-c >/dev/null 2>&1 || missing="$missing frama-c-base"
command -v cppcheck >/dev/null 2>&1 || missing="$missing cppcheck"
command -v clang-14 >/dev/null 2>&1 || missing="$missing clang-14"
# the runtime of sanitizers and fuzzer
case $(clang-14 -print-file-name=libclang_rt.fuzzer-x86_64.a 2>/dev/null || true) in
*/*) ;;
*) find /usr/lib/llvm-14 -name 'libclang_rt.fuzzer*' 2>/dev/null | grep -q . || missing="$missing libclang-rt-14-dev" ;;
esac
[ -n "$missing" ] || exit 0

if [ "$(id -u)" != 0 ] || ! command -v apt-get >/dev/null 2>&1; then
    echo "make prove needs$missing; as root: apt-get install --no-install-recommends$missing" >&2
    exit 1
fi
apt-get update -qq
# shellcheck disable=SC2086
DEBIAN_FRONTEND=noninteractive apt-get install -qq -y --no-install-recommends $missing >/dev/null
