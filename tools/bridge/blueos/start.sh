#!/bin/bash
# Run hub, solver, page and bridge of a vehicle. It ends with the first of them that ends, and BlueOS starts all anew.
# Keys are made once, in the current folder. Settings are environment variables: docs/blueos.md.
set -eu

connect="tls/$HUB_ADDRESS:$HUB_PORT"
[ -e keys/hub.toml ] || buddyline keys init --hub "$HUB_ADDRESS"
for client in solver viewer; do
  [ -e "keys/$client.toml" ] || buddyline keys "$client"
done
for node in $NODES; do
  [ -e "keys/node-$node.toml" ] || buddyline keys node "$node"
done

stop() { kill $(jobs -p) 2>/dev/null || true; wait; }
trap stop EXIT
trap 'exit 0' TERM INT
buddyline hub --config keys/hub.toml --listen "tls/$HUB_LISTEN:$HUB_PORT" &
buddyline solver --config keys/solver.toml --connect "$connect" &
buddyline monitor --config keys/viewer.toml --connect "$connect" --host "$PAGE_LISTEN" --port "$PAGE_PORT" &
# Options are words.
# shellcheck disable=SC2086
buddyline bridge --config keys/viewer.toml --connect "$connect" --vehicle "$VEHICLE" --mavlink "$MAVLINK" \
  $BRIDGE_OPTIONS &
wait -n
