"""A python-socketio client in the place of the simulator: connects, sends telemetry twice, wants a command for each.

usage: client.py URL JPEG
"""

import base64
import sys
import threading
from importlib.metadata import version

import socketio

url, jpeg = sys.argv[1:]
with open(jpeg, "rb") as file:
    image = base64.b64encode(file.read()).decode()
name = f"python-socketio {version('python-socketio')} with python-engineio {version('python-engineio')}"

client = socketio.Client(reconnection=False)
commands = []
done = threading.Event()


def send():
    client.emit(
        "telemetry",
        {"steering_angle": "0.0000", "throttle": "0.0000", "speed": "9.0000", "image": image},
    )


@client.on("connect")
def connected():
    send()


@client.on("steer")
def steer(data):
    commands.append((float(data["steering_angle"]), float(data["throttle"])))
    if len(commands) < 2:
        send()
    else:
        done.set()


client.connect(url, transports=["websocket"])
in_time = done.wait(20)
client.disconnect()
valid = all(-1 <= steering <= 1 and -1 <= throttle <= 1 for steering, throttle in commands)
# Twice the same picture: twice the same steering.
if in_time and valid and commands[0][0] == commands[1][0]:
    print(f"ok: {name}: connected, 2 telemetries, 2 commands: {commands}")
else:
    sys.exit(f"FAILED: {name}: commands {commands}, wanted 2")
