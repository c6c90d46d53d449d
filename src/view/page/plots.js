
// Plots: small ones that move, and the line of merges passed.

const PLOT_POINTS = 160;

function context(canvas) {
  const ratio = Math.min(window.devicePixelRatio || 1, 2);
  const [width, height] = [canvas.clientWidth, canvas.clientHeight];
  if (canvas.width !== Math.round(width * ratio)) {
    canvas.width = Math.round(width * ratio);
    canvas.height = Math.round(height * ratio);
  }
  const drawing = canvas.getContext("2d");
  drawing.setTransform(ratio, 0, 0, ratio, 0, 0);
  drawing.clearRect(0, 0, width, height);
  return { drawing, width, height };
}

class Plot {
  constructor(parent, name, colour, say) {
    this.colour = colour;
    this.say = say;
    this.points = [];
    const row = document.createElement("div");
    row.className = "plot";
    const text = document.createElement("div");
    const label = document.createElement("span");
    label.textContent = name;
    this.value = document.createElement("b");
    text.append(label, this.value);
    this.canvas = document.createElement("canvas");
    row.append(text, this.canvas);
    parent.append(row);
  }

  add(value) {
    this.points.push(value);
    if (this.points.length > PLOT_POINTS) this.points.shift();
    this.value.textContent = this.say(value);
    this.draw();
  }

  draw() {
    const { drawing, width, height } = context(this.canvas);
    if (!width) return;
    const top = Math.max(1e-9, ...this.points) * 1.1;
    const x = i => width * (1 - (this.points.length - 1 - i) / (PLOT_POINTS - 1));
    const y = v => height - 1 - (height - 3) * v / top;
    drawing.beginPath();
    this.points.forEach((v, i) => (i ? drawing.lineTo(x(i), y(v)) : drawing.moveTo(x(i), y(v))));
    drawing.strokeStyle = this.colour;
    drawing.lineWidth = 1.4;
    drawing.stroke();
    drawing.lineTo(width, height);
    drawing.lineTo(x(0), height);
    drawing.globalAlpha = 0.13;
    drawing.fillStyle = this.colour;
    drawing.fill();
    drawing.globalAlpha = 1;
  }
}

const TIMELINE_S = 20;

// Each merge passed is a bar as high as its error; the newest at the right.
class Timeline {
  constructor(canvas, choose) {
    this.canvas = canvas;
    this.marks = [];
    this.chosen = null;
    this.fps = 30;
    this.frame = 0;
    canvas.addEventListener("click", event => {
      const at = event.offsetX;
      const near = this.marks.map(mark => ({ mark, far: Math.abs(this.x(mark.frame) - at) }));
      near.sort((a, b) => a.far - b.far);
      if (near.length && near[0].far < 14) choose(near[0].mark.dead_end);
    });
  }

  x(frame) {
    return this.canvas.clientWidth * (1 - (this.frame - frame) / (TIMELINE_S * this.fps)) - 4;
  }

  add(frame, fps, passed) {
    this.frame = frame;
    this.fps = fps;
    this.marks.push(...passed);
    this.marks = this.marks.filter(mark => frame - mark.frame < TIMELINE_S * fps);
    this.draw();
  }

  draw() {
    const { drawing, width, height } = context(this.canvas);
    if (!width) return;
    const top = Math.max(50, ...this.marks.map(mark => mark.mm));
    drawing.fillStyle = "#31343f";
    for (let second = 0; second <= TIMELINE_S; second += 5) {
      drawing.fillRect(this.x(this.frame - second * this.fps), height - 4, 1, 4);
    }
    for (const mark of this.marks) {
      const tall = 3 + (height - 18) * mark.mm / top;
      drawing.fillStyle = mark.dead_end === this.chosen ? "#e6e4df" : mark.mm > 200 ? "#d1495b" : "#e0a458";
      drawing.fillRect(this.x(mark.frame) - 1.5, height - 4 - tall, 3, tall);
    }
    drawing.fillStyle = "#9a9aa6";
    drawing.font = "11px system-ui, sans-serif";
    drawing.fillText(`${top.toFixed(0)} mm`, 4, 11);
  }
}
