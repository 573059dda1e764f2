#!/bin/bash
# docs/shot.sh RECORDING.rrd PICTURE.png: what a viewer shows, as a picture, without a screen or a GPU; half a minute.
# Debian packages: mesa-vulkan-drivers libvulkan1 (a software Vulkan).  Loopback only.
set -euo pipefail
[ $# -eq 2 ] || { echo "usage: $0 RECORDING.rrd PICTURE.png" >&2; exit 2; }
[ -r "$1" ] || { echo "$0: $1 cannot be read" >&2; exit 66; }
rm -f "$2"
venv=$(cd "$(dirname "$0")/.." && pwd)/.venv
# The program itself: the wrapper bin/rerun, ended, would leave it running.
viewer=$(echo "$venv"/lib/python3*/site-packages/rerun_cli/rerun)
[ -x "$viewer" ] || { echo "$0: no viewer in .venv; run make demo first" >&2; exit 1; }
home=$(mktemp -d) # settings and window state of the viewer: none
pid=
trap '[ -z "$pid" ] || { kill "$pid" && wait "$pid"; } 2>/dev/null || true; rm -rf "$home"' EXIT
drivers=$(echo /usr/share/vulkan/icd.d/lvp_icd*.json)
export HOME="$home" XDG_RUNTIME_DIR="$home" WGPU_BACKEND=vulkan VK_ICD_FILENAMES="$drivers" RUST_LOG=error
port=$("$venv/bin/python" -c 'import socket; s = socket.create_server(("127.0.0.1", 0)); print(s.getsockname()[1])')
"$viewer" analytics disable >"$home/log" 2>&1 || true
"$viewer" "$1" --headless --bind 127.0.0.1 --port "$port" --window-size 1600x1000 --threads 2 >>"$home/log" 2>&1 &
pid=$!
"$venv/bin/python" - "$port" "$2" "$pid" <<'PYTHON' || { cat "$home/log" >&2; exit 1; }
import os
import sys
import time

from rerun.experimental import ViewerClient

port, picture, pid = sys.argv[1], sys.argv[2], int(sys.argv[3])
deadline = time.monotonic() + 120
while True:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        sys.exit("the viewer ended by itself; is a software Vulkan installed?")
    try:
        viewer = ViewerClient(f"rerun+http://127.0.0.1:{port}/proxy")
        state = viewer.get_state()
        if state.recordings and not state.loading:
            break
    except Exception as error:
        if time.monotonic() > deadline:
            sys.exit(f"the viewer does not answer: {error}")
    if time.monotonic() > deadline:
        sys.exit("the recording was not loaded within two minutes")
    time.sleep(0.5)
time.sleep(8)  # views fetch what they show when first drawn
viewer.save_screenshot(os.path.abspath(picture))
until = time.monotonic() + 20
while not (os.path.exists(picture) and os.path.getsize(picture)):
    if time.monotonic() > until:
        sys.exit("the viewer wrote no picture")
    time.sleep(0.2)
time.sleep(1)
PYTHON
