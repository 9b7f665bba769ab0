#!/usr/bin/env bash
# steersman beside TensorFlow, Keras, PyTorch and ONNX Runtime: one command from a checkout. Builds steersman, installs the
# peers into a throw-away environment (or the one in $PEERS_VENV, which is kept), and hands all arguments to compare.py.
set -euo pipefail
here="$(cd "$(dirname "$0")" && pwd)"
cargo build --release --manifest-path "$here/../../Cargo.toml"
if [ -n "${PEERS_VENV:-}" ]; then
  venv="$PEERS_VENV"
else
  venv="$(mktemp -d)"
  trap 'rm -rf "$venv"' EXIT
fi
if [ ! -x "$venv/bin/python" ]; then
  python3 -m venv "$venv"
  "$venv/bin/pip" install --quiet --requirement "$here/requirements.txt"
fi
"$venv/bin/python" "$here/compare.py" "$@"
