#!/bin/sh
# Install what `make prove` or `make firmware` needs, or the browser in which tests open the report, on Debian and
# Ubuntu; where that is not possible, name it.
set -eu

missing=
needs() { command -v "$1" >/dev/null 2>&1 || missing="$missing $2"; }
# a file that a compiler finds has a path
has() { case $("$1" -print-file-name="$2" 2>/dev/null || true) in */*) ;; *) return 1 ;; esac; }

case ${1-} in
prove)
    needs frama-c frama-c-base
    needs cppcheck cppcheck
    needs clang-14 clang-14
    # the runtime of sanitizers and fuzzer
    has clang-14 libclang_rt.fuzzer-x86_64.a ||
        find /usr/lib/llvm-14 -name 'libclang_rt.fuzzer*' 2>/dev/null | grep -q . || missing="$missing libclang-rt-14-dev"
    ;;
firmware)
    needs qemu-system-arm qemu-system-arm
    needs arm-none-eabi-gcc gcc-arm-none-eabi
    has arm-none-eabi-gcc libm.a || missing="$missing libnewlib-arm-none-eabi"
    ;;
browser)
    needs chromium chromium
    ;;
*)
    echo "usage: install.sh prove|firmware|browser" >&2
    exit 2
    ;;
esac
[ -n "$missing" ] || exit 0

if [ "$(id -u)" != 0 ] || ! command -v apt-get >/dev/null 2>&1; then
    echo "$1 needs$missing; as root: apt-get install --no-install-recommends$missing" >&2
    exit 1
fi
apt-get update -qq
# shellcheck disable=SC2086
DEBIAN_FRONTEND=noninteractive apt-get install -qq -y --no-install-recommends $missing >/dev/null
