// The texture's pages, to zoom into: buttons, keys + and -, Ctrl and wheel; dragging moves.

import { el } from "./base.js";

const STEP = 1.5;
const MOST = 16;

export function showAtlas(section, names, address) {
  const pages = names.filter(address);
  if (!pages.length) return;
  let zoom = 1;
  const picture = el("img", { alt: "The texture, all its charts side by side", draggable: false, loading: "lazy" });
  const frame = el("div", { class: "zoomed", tabIndex: 0, role: "region", "aria-label": "Texture atlas; keys plus and minus zoom, arrows move" }, picture);
  const shown = el("output", { class: "hint num", "aria-live": "polite" });

  function fitted() {
    return Math.min(frame.clientWidth, (frame.clientHeight * picture.naturalWidth) / picture.naturalHeight || frame.clientWidth);
  }

  /** Zooms about a point of the frame, its middle if none is given. */
  function to(value, x = frame.clientWidth / 2, y = frame.clientHeight / 2) {
    const before = zoom;
    zoom = Math.min(MOST, Math.max(1, value));
    const [left, top] = [frame.scrollLeft + x, frame.scrollTop + y];
    picture.style.width = `${fitted() * zoom}px`;
    frame.scrollTo((left * zoom) / before - x, (top * zoom) / before - y);
    shown.textContent = picture.naturalWidth ? `${Math.round((100 * fitted() * zoom) / picture.naturalWidth)} %` : "";
  }

  let held = null;
  frame.addEventListener("pointerdown", (event) => {
    held = event.pointerType === "mouse" ? [event.clientX + frame.scrollLeft, event.clientY + frame.scrollTop] : null;
  });
  addEventListener("pointerup", () => { held = null; });
  frame.addEventListener("pointermove", (event) => held && frame.scrollTo(held[0] - event.clientX, held[1] - event.clientY));
  frame.addEventListener("wheel", (event) => {
    if (!event.ctrlKey) return;
    event.preventDefault();
    const box = frame.getBoundingClientRect();
    to(zoom * (event.deltaY < 0 ? STEP : 1 / STEP), event.clientX - box.left, event.clientY - box.top);
  }, { passive: false });
  frame.addEventListener("keydown", (event) => {
    if (event.key === "+" || event.key === "=") to(zoom * STEP);
    else if (event.key === "-") to(zoom / STEP);
    else if (event.key === "0") to(1);
  });
  picture.addEventListener("load", () => to(1));
  addEventListener("resize", () => to(zoom));
  const button = (name, label, act) => el("button", { type: "button", "aria-label": label, onclick: act }, name);
  section.append(
    el("div", { class: "toolbar" },
      button("−", "Zoom out", () => to(zoom / STEP)), button("+", "Zoom in", () => to(zoom * STEP)),
      button("Fit", "Fit into the frame", () => to(1)), shown,
      pages.length > 1 && pages.map((page, index) => button(`Page ${index + 1}`, `Page ${index + 1}`, () => { picture.src = address(page); }))),
    frame);
  section.hidden = false;
  picture.src = address(pages[0]);
}
