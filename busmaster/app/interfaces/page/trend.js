// A trend on a small canvas: a line through the numbers, with a mark where there was no value. Texts have none.

export function fit(canvas) {
  const scale = devicePixelRatio || 1;
  const width = canvas.clientWidth, height = canvas.clientHeight;
  if (canvas.width !== Math.round(width * scale) || canvas.height !== Math.round(height * scale)) {
    canvas.width = Math.round(width * scale);
    canvas.height = Math.round(height * scale);
  }
  const pen = canvas.getContext("2d");
  pen.setTransform(scale, 0, 0, scale, 0, 0);
  pen.clearRect(0, 0, width, height);
  return { pen, width, height };
}

export function draw_trend(canvas, { past, value: last }, { ink, bad }) {
  const { pen, width, height } = fit(canvas);
  const numbers = past.map(([, value]) => value).filter((value) => value !== null);
  if (!past.length || !width || (!numbers.length && typeof last === "string")) return;
  const low = Math.min(...numbers), high = Math.max(...numbers);
  const begin = past[0][0], span = past.at(-1)[0] - begin || 1;
  const flat = high === low;
  const x = (when) => ((when - begin) / span) * (width - 6) + 3;
  const y = (value) => (flat ? height / 2 : height - 3 - ((value - low) / (high - low)) * (height - 6));
  pen.lineWidth = 1.5;
  pen.strokeStyle = ink;
  pen.beginPath();
  let broken = true;
  for (const [when, value] of past) {
    if (value === null) broken = true;
    else if (broken) { pen.moveTo(x(when), y(value)); pen.lineTo(x(when) + 0.5, y(value)); broken = false; }
    else pen.lineTo(x(when), y(value));
  }
  pen.stroke();
  pen.fillStyle = bad;
  for (const [when, value] of past) if (value === null) pen.fillRect(x(when) - 0.5, height - 3, 1.5, 3);
}
