// Where one looks: a place and a zoom that several panes share.

const MOST = 64;

/** A place (the picture's pixel in the middle of a pane) and a zoom (pane pixels a picture pixel). */
export class View {
  constructor(height, width) {
    Object.assign(this, { height, width, listeners: new Set() });
    this.fit();
  }

  /** All of the picture; each pane takes the zoom that its size asks for. */
  fit() {
    Object.assign(this, { zoom: null, x: this.width / 2, y: this.height / 2 });
    this.tell();
  }

  tell() {
    this.listeners.forEach((listener) => listener());
  }

  listen(listener, signal) {
    this.listeners.add(listener);
    signal.addEventListener("abort", () => this.listeners.delete(listener), { once: true });
  }

  pan(dx, dy) {
    this.x = clamp(this.x + dx, 0, this.width);
    this.y = clamp(this.y + dy, 0, this.height);
    this.tell();
  }

  /** Zooms by a factor from `now` so that the pixel at (x, y) stays where it is. */
  zoomBy(factor, now, x = this.x, y = this.y) {
    const least = 16 / Math.max(this.width, this.height);
    const next = clamp(now * factor, least, MOST);
    const keep = now / next;
    this.zoom = next;
    this.x = clamp(x + (this.x - x) * keep, 0, this.width);
    this.y = clamp(y + (this.y - y) * keep, 0, this.height);
    this.tell();
  }
}

function clamp(value, least, most) {
  return Math.min(most, Math.max(least, value));
}

/** Lets a pane's canvas be dragged, pinched, turned the wheel over and driven by keys. */
export function steer(canvas, view, pane, signal) {
  const pointers = new Map();
  // One finger is for the page, unless the picture is all there is.
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
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    pointers.set(event.pointerId, event);
  }, { signal });
  canvas.addEventListener("pointermove", (event) => {
    const before = pointers.get(event.pointerId);
    if (!before) return;
    const { zoom } = pane.place();
    if (idle()) {
      // Nothing: the browser scrolls.
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
  for (const kind of ["pointerup", "pointercancel"]) {
    canvas.addEventListener(kind, (event) => pointers.delete(event.pointerId), { signal });
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
