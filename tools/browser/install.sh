#!/bin/sh
# Install the browser in which tests open the report, on Debian and Ubuntu; where that is not possible, name it.
set -eu

command -v chromium >/dev/null 2>&1 && exit 0
if [ "$(id -u)" != 0 ] || ! command -v apt-get >/dev/null 2>&1; then
    echo "the report is not opened in a browser: as root, apt-get install --no-install-recommends chromium" >&2
    exit 0
fi
apt-get update -qq
DEBIAN_FRONTEND=noninteractive apt-get install -qq -y --no-install-recommends chromium >/dev/null
