// Returns how much lighter or darker than the sheet its text is, at least.
const channel = (part) => (part / 255 <= 0.03928 ? part / 255 / 12.92 : ((part / 255 + 0.055) / 1.055) ** 2.4);
const light = (text) => {
  const [r, g, b] = text.match(/[\d.]+/g).map(channel);
  return 0.2126 * r + 0.7152 * g + 0.0722 * b;
};
const ground = light(getComputedStyle(document.getElementById('points')).backgroundColor);
const places = ['h2', '#node-list small', '#node-list b', 'th', 'td.value', '#wire-said', '#state', '#found'];
return Math.min(...places.map((place) => {
  const ink = light(getComputedStyle(document.querySelector(place)).color);
  return (Math.max(ink, ground) + 0.05) / (Math.min(ink, ground) + 0.05);
}));
