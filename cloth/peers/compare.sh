#!/usr/bin/env bash
# Toile beside MuJoCo and Blender on S1 and S2: see compare.py. Needs python3.11 (Blender's wheel asks for it).
# The environment is made once in target/peers, or found in $TOILE_PEERS_VENV.
set -euo pipefail
here=$(cd "$(dirname "$0")" && pwd)
root=$(cd "$here/../.." && pwd)
env=${TOILE_PEERS_VENV:-$root/target/peers}
if [ ! -x "$env/bin/python" ]; then
  python3.11 -m venv "$env"
  "$env/bin/pip" install --quiet 'numpy<2' scipy mujoco bpy==5.0.1
fi
[ -n "${TOILE_SKIP_BUILD:-}" ] || cargo build --release --manifest-path "$root/Cargo.toml" --bin toile
exec "$env/bin/python" "$here/compare.py" "$@"
