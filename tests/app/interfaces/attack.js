// What a page of another site tries on the page at given[0]; returns what came of each.
const url = given[0];
const point = `${url}api/points/axes/5/10`;
const body = '{"value": 9}';
const attempts = {
  json: () => fetch(point, { method: 'PUT', body, headers: { 'Content-Type': 'application/json' } }),
  plain: () => fetch(point, { method: 'PUT', body, headers: { 'Content-Type': 'text/plain' } }),
  post: () => fetch(point, { method: 'POST', mode: 'no-cors', body }),
  read: () => fetch(`${url}api/points`),
  script: () => loaded('script', { src: `${url}page/page.js` }),
  socket: () => new Promise((good, bad) => {
    const socket = new WebSocket(`${url.replace('http', 'ws')}api/stream`);
    socket.onopen = good;
    socket.onerror = bad;
  }),
  frame: async () => (await loaded('iframe', { src: url })).contentDocument.title,
};

function loaded(name, fields) {
  return new Promise((good, bad) => {
    const element = Object.assign(document.createElement(name), fields, { onerror: bad });
    element.onload = () => good(element);
    document.body.append(element);
  });
}

const outcomes = {};
for (const [name, attempt] of Object.entries(attempts)) {
  outcomes[name] = await attempt().then(() => 'done', () => 'refused');
}
return outcomes;
