// Position and zoom that several panes share.

/** Largest zoom in pane pixels per image pixel. */
const MAX_ZOOM = 64;
/** Largest movement of a click in pixels. */
const CLICK = 4;

/** Position (the image pixel in the middle of a pane) and zoom (pane pixels per image pixel). */
export class View {
  constructor(height, width) {
    Object.assign(this, { height, width, listeners: new Set() });
    this.fit();
  }

  /** Shows the whole image: each pane computes the zoom from its size. */
  fit() {
    Object.assign(this, { zoom: null, x: this.width / 2, y: this.height / 2 });
    this.notify();
  }

  /** Takes the size of another picture, and shows it whole. */
  resize(height, width) {
    if (this.height === height && this.width === width) return;
    Object.assign(this, { height, width });
    this.fit();
  }

  notify() {
    this.listeners.forEach((listener) => listener());
  }

  listen(listener, signal) {
    this.listeners.add(listener);
    signal.addEventListener("abort", () => this.listeners.delete(listener), { once: true });
  }

  pan(dx, dy) {
    this.x = clamp(this.x + dx, 0, this.width);
    this.y = clamp(this.y + dy, 0, this.height);
    this.notify();
  }

  /** Multiplies the zoom `now` by a factor and keeps the pixel at (x, y) in place. */
  zoomBy(factor, now, x = this.x, y = this.y) {
    const least = 16 / Math.max(this.width, this.height);
    const next = clamp(now * factor, least, MAX_ZOOM);
    const keep = now / next;
    this.zoom = next;
    this.x = clamp(x + (this.x - x) * keep, 0, this.width);
    this.y = clamp(y + (this.y - y) * keep, 0, this.height);
    this.notify();
  }
}

function clamp(value, least, most) {
  return Math.min(most, Math.max(least, value));
}

/** Moves and zooms a view by dragging, pinching, the wheel and keys on a canvas. */
export function steer(canvas, view, pane, signal) {
  const pointers = new Map();
  // One finger scrolls the page, except in full screen.
  const idle = () => pointers.size === 1 && [...pointers.values()][0].pointerType === "touch" && !document.fullscreenElement;
  const hold = (event) => event.touches.length > 1 && event.cancelable && event.preventDefault();
  for (const kind of ["touchstart", "touchmove"]) canvas.addEventListener(kind, hold, { signal, passive: false });
  const place = (event) => {
    const box = canvas.getBoundingClientRect();
    const { zoom } = pane.place();
    return {
      x: view.x + (event.clientX - box.left - box.width / 2) / zoom,
      y: view.y + (event.clientY - box.top - box.height / 2) / zoom,
    };
  };
  // `pressed` is the event of the last press, `drawing` the start of a line or rectangle that a tool draws.
  let [pressed, drawing] = [null, null];
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    pointers.set(event.pointerId, event);
    pressed = pointers.size === 1 && event.button === 0 ? event : null;
    drawing = pressed && event.pointerType !== "touch" && pane.tool?.draws() ? place(event) : null;
  }, { signal });
  canvas.addEventListener("pointerleave", () => pane.hover(null), { signal });
  canvas.addEventListener("pointermove", (event) => {
    const before = pointers.get(event.pointerId);
    if (!before || drawing) {
      pane.hover(place(event));
      if (drawing) pane.tool.draw(drawing, place(event), false);
      return;
    }
    const { zoom } = pane.place();
    if (idle()) {
      // The browser scrolls the page.
    } else if (pointers.size === 1) {
      if (view.zoom === null) view.zoom = zoom;
      view.pan((before.clientX - event.clientX) / zoom, (before.clientY - event.clientY) / zoom);
    } else if (pointers.size === 2) {
      const other = [...pointers.values()].find((pointer) => pointer.pointerId !== event.pointerId);
      const span = (pointer) => Math.hypot(pointer.clientX - other.clientX, pointer.clientY - other.clientY);
      const { x, y } = place(other);
      if (span(before) > 0) view.zoomBy(span(event) / span(before), zoom, x, y);
    }
    pointers.set(event.pointerId, event);
  }, { signal });
  canvas.addEventListener("pointerup", (event) => {
    if (drawing) pane.tool.draw(drawing, place(event), true);
    else if (pressed && Math.hypot(event.clientX - pressed.clientX, event.clientY - pressed.clientY) < CLICK) {
      pane.hover(place(event));
      pane.tool?.click(place(event));
    }
  }, { signal });
  for (const kind of ["pointerup", "pointercancel"]) {
    canvas.addEventListener(kind, (event) => {
      pointers.delete(event.pointerId);
      drawing = pressed = null;
    }, { signal });
  }
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    const { x, y } = place(event);
    view.zoomBy(2 ** (-event.deltaY / (event.deltaMode === 0 ? 300 : 10)), pane.place().zoom, x, y);
  }, { signal, passive: false });
  canvas.addEventListener("dblclick", () => view.fit(), { signal });
  canvas.addEventListener("keydown", (event) => key(event, view, pane), { signal });
}

function key(event, view, pane) {
  if (event.ctrlKey || event.metaKey || event.altKey) return;
  const { zoom } = pane.place();
  const step = 60 / zoom;
  const moves = { ArrowUp: [0, -step], ArrowDown: [0, step], ArrowLeft: [-step, 0], ArrowRight: [step, 0] };
  if (event.shiftKey && moves[event.key]) view.pan(...moves[event.key]);
  else if (event.key === "+" || event.key === "=") view.zoomBy(1.5, zoom);
  else if (event.key === "-") view.zoomBy(1 / 1.5, zoom);
  else if (event.key === "0") view.fit();
  else if (event.key === "1") view.zoomBy(1 / zoom, zoom);
  else return;
  event.preventDefault();
  event.stopPropagation();
}
