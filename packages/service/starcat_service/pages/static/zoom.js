// A picture in a box: buttons, Ctrl and the wheel, or a double click zoom it; dragging moves it.

const MOST = 8;

function startZoom(figure) {
  const box = figure.querySelector(".zoom");
  const picture = box.querySelector("img");
  let zoom = 1;
  const set = (magnification, x = box.clientWidth / 2, y = box.clientHeight / 2) => {
    const before = picture.getBoundingClientRect();
    const bounds = box.getBoundingClientRect();
    const at = [(bounds.left + x - before.left) / before.width, (bounds.top + y - before.top) / before.height];
    zoom = Math.max(1, Math.min(MOST, magnification));
    box.style.setProperty("--zoom", zoom);
    box.scrollTo(at[0] * picture.offsetWidth - x, at[1] * picture.offsetHeight - y);
  };
  const pointerPosition = (event) => {
    const bounds = box.getBoundingClientRect();
    return [event.clientX - bounds.left, event.clientY - bounds.top];
  };
  const tools = figure.querySelector(".zoom-tools");
  tools.hidden = false;
  tools.querySelector("a[download]").href = picture.src; // the page holds the picture once
  tools.addEventListener("click", (event) => {
    const by = event.target.closest("[data-zoom]")?.dataset.zoom;
    if (by) set(by === "0" ? 1 : zoom * Number(by));
  });
  box.addEventListener("wheel", (event) => {
    if (!event.ctrlKey) return;
    event.preventDefault();
    set(zoom * (event.deltaY < 0 ? 1.25 : 0.8), ...pointerPosition(event));
  }, { passive: false });
  box.addEventListener("dblclick", (event) => set(2 * zoom, ...pointerPosition(event)));
  picture.draggable = false;
  box.addEventListener("pointermove", (event) => {
    if (event.pointerType === "mouse" && event.buttons === 1) box.scrollBy(-event.movementX, -event.movementY);
  });
}

for (const figure of document.querySelectorAll("figure.picture")) startZoom(figure);
