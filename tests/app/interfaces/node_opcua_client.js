// A client of node-opcua: subscribes once to the points named on its command line and prints what it receives, one
// JSON object a line. It never subscribes again by itself: what comes after a lost connection is the library's doing.
const { OPCUAClient, AttributeIds, ClientSubscription, ClientMonitoredItem, TimestampsToReturn } = require("node-opcua");

const [url, ...names] = process.argv.slice(2);
const say = (what) => process.stdout.write(JSON.stringify(what) + "\n");

(async () => {
    const client = OPCUAClient.create({
        endpointMustExist: false,
        connectionStrategy: { initialDelay: 100, maxDelay: 500, maxRetry: -1 },
    });
    client.on("send_request", (request) => {
        if (request.schema.name === "RepublishRequest") say({ sent: request.schema.name });
    });
    await client.connect(url);
    const session = await client.createSession();
    const subscription = ClientSubscription.create(session, {
        requestedPublishingInterval: 100,
        requestedLifetimeCount: 1000,
        requestedMaxKeepAliveCount: 10,
        publishingEnabled: true,
    });
    for (const name of names) {
        const item = ClientMonitoredItem.create(
            subscription,
            { nodeId: `ns=2;s=${name}`, attributeId: AttributeIds.Value },
            { samplingInterval: 100, queueSize: 5, discardOldest: true },
            TimestampsToReturn.Both,
        );
        item.on("changed", (told) => say({ name, value: told.value.value, status: told.statusCode.name }));
        item.on("err", (text) => say({ name, error: text }));
    }
})().catch((error) => {
    say({ error: String(error) });
    process.exit(1);
});
