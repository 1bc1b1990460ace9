// What all scripts make elements with.

/** An element; properties as they are, `class`, `aria-…` and `data-…` as attributes. Text never becomes markup. */
export function el(tag, properties = {}, ...children) {
  const element = tag.startsWith("svg:")
    ? document.createElementNS("http://www.w3.org/2000/svg", tag.slice(4)) : document.createElement(tag);
  for (const [name, value] of Object.entries(properties)) {
    if (value === false || value == null) continue;
    if (name in element && !name.includes("-") && !tag.startsWith("svg:")) element[name] = value;
    else element.setAttribute(name, value);
  }
  element.append(...children.flat().filter((child) => child != null && child !== false));
  return element;
}
