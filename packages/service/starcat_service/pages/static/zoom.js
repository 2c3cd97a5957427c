// A picture in a box: buttons, Ctrl and the wheel, or a double click zoom it; dragging moves it.

const MOST = 8;

function startZoom(figure) {
  const box = figure.querySelector(".zoom");
  const picture = box.querySelector("img");
  let zoom = 1;
  const set = (wanted, x = box.clientWidth / 2, y = box.clientHeight / 2) => {
    const before = picture.getBoundingClientRect();
    const own = box.getBoundingClientRect();
    const at = [(own.left + x - before.left) / before.width, (own.top + y - before.top) / before.height];
    zoom = Math.max(1, Math.min(MOST, wanted));
    box.style.setProperty("--zoom", zoom);
    box.scrollTo(at[0] * picture.offsetWidth - x, at[1] * picture.offsetHeight - y);
  };
  const place = (event) => {
    const own = box.getBoundingClientRect();
    return [event.clientX - own.left, event.clientY - own.top];
  };
  const tools = figure.querySelector(".zoom-tools");
  tools.hidden = false;
  tools.addEventListener("click", (event) => {
    const by = event.target.closest("[data-zoom]")?.dataset.zoom;
    if (by) set(by === "0" ? 1 : zoom * Number(by));
  });
  box.addEventListener("wheel", (event) => {
    if (!event.ctrlKey) return;
    event.preventDefault();
    set(zoom * (event.deltaY < 0 ? 1.25 : 0.8), ...place(event));
  }, { passive: false });
  box.addEventListener("dblclick", (event) => set(2 * zoom, ...place(event)));
  picture.draggable = false;
  box.addEventListener("pointermove", (event) => {
    if (event.pointerType === "mouse" && event.buttons === 1) box.scrollBy(-event.movementX, -event.movementY);
  });
}

for (const figure of document.querySelectorAll("figure.picture")) startZoom(figure);
