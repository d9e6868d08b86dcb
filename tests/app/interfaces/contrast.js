// Returns how much lighter or darker than the sheet the colours of its text are, at least.
const style = getComputedStyle(document.documentElement);
const channel = (part) => (part <= 0.03928 ? part / 12.92 : ((part + 0.055) / 1.055) ** 2.4);
const light = (name) => {
  const said = style.getPropertyValue(`--${name}`).trim().replace(/^#(.)(.)(.)$/, '#$1$1$2$2$3$3');
  const [r, g, b] = [1, 3, 5].map((at) => channel(parseInt(said.slice(at, at + 2), 16) / 255));
  return 0.2126 * r + 0.7152 * g + 0.0722 * b;
};
const sheet = light('sheet');
return Math.min(...['ink', 'dim', 'ok', 'warn', 'bad'].map((name) => {
  const ink = light(name);
  return (Math.max(ink, sheet) + 0.05) / (Math.min(ink, sheet) + 0.05);
}));
