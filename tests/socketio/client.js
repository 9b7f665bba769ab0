// A JavaScript socket.io-client in the place of the simulator: connects, sends telemetry twice, wants a command for each.
//
// usage: node client.js PACKAGE URL JPEG
"use strict";

const fs = require("fs");

const [, , packageName, url, jpeg] = process.argv;
const { version } = require(`${packageName}/package.json`);
const { io } = (() => {
  const client = require(packageName);
  return client.io ? client : { io: client };
})();
const name = `socket.io-client ${version}`;
const image = fs.readFileSync(jpeg).toString("base64");
const commands = [];

const finish = (trouble) => {
  socket.close();
  const valid = commands.every(([s, t]) => s >= -1 && s <= 1 && t >= -1 && t <= 1);
  // Twice the same picture: twice the same steering.
  if (!trouble && valid && commands.length === 2 && commands[0][0] === commands[1][0]) {
    console.log(`ok: ${name}: connected, 2 telemetries, 2 commands: ${JSON.stringify(commands)}`);
    process.exit(0);
  }
  console.error(`FAILED: ${name}: ${trouble || ""} commands ${JSON.stringify(commands)}, wanted 2`);
  process.exit(1);
};

const socket = io(url, { transports: ["websocket"], reconnection: false });
const send = () =>
  socket.emit("telemetry", { steering_angle: "0.0000", throttle: "0.0000", speed: "9.0000", image });
socket.on("connect", send);
socket.on("connect_error", (error) => finish(`cannot connect: ${error.message};`));
socket.on("steer", (data) => {
  commands.push([parseFloat(data.steering_angle), parseFloat(data.throttle)]);
  if (commands.length < 2) send();
  else finish();
});
setTimeout(() => finish("too late;"), 20000);
