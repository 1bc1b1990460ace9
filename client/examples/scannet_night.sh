#!/usr/bin/env bash
# Texture the scenes of a ScanNet root overnight, wait for them, and write the report.
#
#     scannet_night.sh /data/ScanNet night1 [NAMES of options...]      e.g. --preset standard --holdout 8
#
# ADVTEX_URL and ADVTEX_API_KEY name the server. Run it again with the same names after a break: it goes on, and
# nothing is sent or queued twice. Its exit code is 5 if a scene did not succeed.
set -euo pipefail
root=$1 night=$2
shift 2

# 4: some scenes cannot be textured, and it says which; the others are on their way.
advtex-client batch submit "$root" --id "$night" "$@" || [ $? = 4 ]
ended=0
advtex-client batch status "$night" --wait || ended=$?
advtex-client batch report "$night" --output "$night.html"
exit "$ended"
