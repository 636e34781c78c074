#!/bin/sh
# Install what `make firmware` needs, on Debian and Ubuntu; where that is not possible, name it.
set -eu

missing=
command -v qemu-system-arm >/dev/null 2>&1 || missing="$missing qemu-system-arm"
command -v arm-none-eabi-gcc >/dev/null 2>&1 || missing="$missing gcc-arm-none-eabi"
# a library that the compiler finds has a path
case $(arm-none-eabi-gcc -print-file-name=libm.a 2>/dev/null || true) in
*/*) ;;
*) missing="$missing libnewlib-arm-none-eabi" ;;
esac
[ -n "$missing" ] || exit 0

if [ "$(id -u)" != 0 ] || ! command -v apt-get >/dev/null 2>&1; then
    echo "make firmware needs$missing; as root: apt-get install --no-install-recommends$missing" >&2
    exit 1
fi
apt-get update -qq
# shellcheck disable=SC2086
DEBIAN_FRONTEND=noninteractive apt-get install -qq -y --no-install-recommends $missing >/dev/null
