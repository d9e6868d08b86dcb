// A client of Modbus TCP, modbus-serial: `node client.js PORT STEPS.json` does what clients.py says of all.
"use strict";
const fs = require("fs");
const ModbusRTU = require("modbus-serial");

async function main() {
    const client = new ModbusRTU();
    await client.connectTCP("127.0.0.1", { port: Number(process.argv[2]) });
    client.setTimeout(20000);
    for (const [kind, unit, first, what] of JSON.parse(fs.readFileSync(process.argv[3]))) {
        const began = process.hrtime.bigint();
        const reply = { code: 0, values: [] };
        try {
            client.setID(unit);
            if (kind === "read") {
                reply.values = (await client.readHoldingRegisters(first, what)).data;
            } else {
                await client.writeRegister(first, what);
            }
        } catch (error) {
            reply.code = error.modbusCode || -1;
            reply.why = String(error.message);
        }
        reply.seconds = Number(process.hrtime.bigint() - began) / 1e9;
        process.stdout.write(JSON.stringify(reply) + "\n");
    }
    client.close(() => {});
}

main();
