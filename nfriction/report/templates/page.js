"use strict";
// Headings sort their table: numbers by what they stand for, words by the alphabet.
for (const button of document.querySelectorAll("thead button")) {
  button.addEventListener("click", () => {
    const head = button.closest("th");
    const column = head.cellIndex;
    const body = head.closest("table").tBodies[0];
    const descending = head.getAttribute("aria-sort") === "ascending";
    const key = (row) => row.cells[column].dataset.value;
    const word = (row) => row.cells[column].textContent;
    const order = (a, b) => {
      if (key(a) === undefined || key(b) === undefined) {
        return word(a).localeCompare(word(b), "en", { numeric: true });
      }
      const [x, y] = [Number(key(a)), Number(key(b))];
      return x === y ? 0 : x < y ? -1 : 1;
    };
    const rows = [...body.rows].sort((a, b) => (descending ? order(b, a) : order(a, b)));
    body.append(...rows);
    for (const other of head.parentNode.cells) other.setAttribute("aria-sort", "none");
    head.setAttribute("aria-sort", descending ? "descending" : "ascending");
  });
}

// A figure opens over the page; it grows by its buttons, the wheel or + and -, and is dragged.
const dialog = document.querySelector("dialog");
const view = dialog.querySelector(".view");
const picture = view.querySelector("img");
let scale = 1;

const fitted = () => {
  const [w, h] = [picture.naturalWidth, picture.naturalHeight];
  // Of the whole view: scroll bars, where there are some, go with the larger picture.
  return w * Math.min(view.offsetWidth / w, view.offsetHeight / h);
};

const zoomTo = (wanted, x = view.clientWidth / 2, y = view.clientHeight / 2) => {
  const before = scale;
  scale = Math.min(Math.max(wanted, 1), 12);
  const [left, top] = [view.scrollLeft + x, view.scrollTop + y];
  picture.style.width = `${fitted() * scale}px`;
  view.scrollLeft = (left * scale) / before - x;
  view.scrollTop = (top * scale) / before - y;
};

const actions = {
  in: () => zoomTo(scale * 1.5),
  out: () => zoomTo(scale / 1.5),
  fit: () => zoomTo(1),
  close: () => dialog.close(),
};

for (const button of dialog.querySelectorAll("[data-do]")) {
  button.addEventListener("click", actions[button.dataset.do]);
}

for (const button of document.querySelectorAll(".zoom")) {
  button.addEventListener("click", async () => {
    const small = button.querySelector("img");
    picture.style.width = "0"; // until its size is known
    picture.alt = small.alt;
    picture.src = small.src;
    dialog.setAttribute("aria-label", small.alt);
    dialog.showModal();
    await picture.decode();
    scale = 1;
    zoomTo(1);
  });
}

dialog.addEventListener("keydown", (event) => {
  const action = { "+": "in", "=": "in", "-": "out", 0: "fit" }[event.key];
  if (action) actions[action]();
});

view.addEventListener("wheel", (event) => {
  event.preventDefault();
  const box = view.getBoundingClientRect();
  zoomTo(scale * Math.exp(-event.deltaY / 400), event.clientX - box.left, event.clientY - box.top);
}, { passive: false });

view.addEventListener("pointermove", (event) => {
  if (event.buttons !== 1 || event.pointerType === "touch") return;
  event.preventDefault();
  view.scrollLeft -= event.movementX;
  view.scrollTop -= event.movementY;
});
view.addEventListener("dragstart", (event) => event.preventDefault());
addEventListener("resize", () => dialog.open && zoomTo(scale));
