#!/usr/bin/env bash
# Makes the simulated recordings anew: ./recordings/make_simulated.sh (from the project's folder)
set -eu
simulate() { .venv/bin/shm-monitor simulate --structure recordings/frame-truth.toml --rate 200 --noise 0.05 --level-spread 0.35 "$@"; }
simulate --out recordings/frame-healthy.mcap --duration 800 --seed 11 --start 2026-03-01T00:00:00
simulate --out recordings/frame-before.mcap --duration 400 --seed 12 --start 2026-03-02T00:00:00
simulate --out recordings/frame-after.mcap --duration 600 --seed 13 --start 2026-03-02T00:06:40 --damage story2=0.12
