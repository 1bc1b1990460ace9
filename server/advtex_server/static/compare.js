// Two pictures from the same camera under one slider, for every view that has them.

import { el } from "./base.js";

const PAIRS = {
  photo: { title: "Photograph | result", left: "photo", right: "render", tags: ["Photograph", "Result"] },
  mean: { title: "Average | result", left: "mean", right: "render", tags: ["Plain average", "Result"] },
  input: { title: "Photograph | average", left: "photo", right: "mean", tags: ["Photograph", "Plain average"] },
};

/** views: of `previews/manifest.json`. address: the URL of a result file, null if there is none. */
export function showComparison(section, views, address) {
  const shown = views.filter((view) => address(view.photo) && address(view.render));
  if (!shown.length) return;
  let [view, pair] = [shown.find((found) => found.heldout) ?? shown[0], PAIRS.photo];
  const [under, over] = [el("img", { draggable: false }), el("img", { class: "over", draggable: false })];
  const range = el("input", { type: "range", min: 0, max: 100, step: 0.5, value: 50 });
  const tags = [el("span", { class: "tag left" }), el("span", { class: "tag right" })];
  const slider = el("div", { class: "slider" }, under, over, el("div", { class: "edge" }), ...tags, range);
  const caption = el("p", { class: "caption" });

  function move() {
    slider.style.setProperty("--at", `${range.value}%`);
    range.setAttribute("aria-valuetext", `${Math.round(range.value)} % ${pair.tags[0].toLowerCase()}`);
  }

  function draw() {
    slider.style.aspectRatio = `${view.width} / ${view.height}`;
    slider.style.width = `min(100%, ${Math.round((620 * view.width) / view.height)}px)`;
    over.src = address(view[pair.left]);
    under.src = address(view[pair.right]);
    over.alt = `${pair.tags[0]} of view ${view.name}`;
    under.alt = `${pair.tags[1]} from the same camera`;
    tags.forEach((tag, index) => { tag.textContent = pair.tags[index]; });
    range.setAttribute("aria-label", `${pair.tags[0]} against ${pair.tags[1].toLowerCase()}`);
    const role = view.heldout ? ": held out, so the texture was made without this photograph" : "";
    caption.textContent = `View ${view.name}${role}`;
    for (const button of strip.children) button.setAttribute("aria-pressed", String(button.view === view));
    move();
  }

  const choice = ([name, found], index) => el("label", {},
    el("input", { class: "away", type: "radio", name: "pair", value: name, checked: index === 0,
      onchange: () => { pair = found; draw(); } }), found.title);
  const strip = el("div", { class: "strip", role: "group", "aria-label": "Views" }, shown.map((found) => {
    const label = `View ${found.name}${found.heldout ? ", held out" : ""}`;
    const button = el("button", { type: "button", "aria-label": label, title: label, onclick: () => { view = found; draw(); } },
      el("img", { src: address(found.photo), alt: "", loading: "lazy" }),
      found.heldout && el("span", { class: "badge heldout" }, "held out"));
    button.view = found;
    return button;
  }));
  range.addEventListener("input", move);
  const pairs = Object.entries(PAIRS).filter(([, found]) => address(shown[0][found.left]) && address(shown[0][found.right]));
  section.append(
    el("div", { class: "segmented", role: "radiogroup", "aria-label": "What to compare" }, pairs.map(choice)),
    slider, caption, strip);
  section.hidden = false;
  draw();
}
