// Films of a file, by concept, and nothing else: what `view FILE` shows.
const viewer = { hidden: new Set(), boxes: [] };

function setViewer(found) {
  find("view-title").textContent = found.title;
  find("view-told").replaceChildren(...found.told.map((text) => made("li", { textContent: text })));
  find("view-concepts").replaceChildren(find("view-concepts").querySelector("legend"), ...found.groups.map((group) => {
    const box = made("input", { type: "checkbox", checked: true });
    box.addEventListener("change", () => { box.checked ? viewer.hidden.delete(group.concept) : viewer.hidden.add(group.concept); viewed(); });
    return made("label", { className: "check" }, box, `${group.concept} (${group.films.length})`);
  }));
  find("view-text").addEventListener("input", viewed);
  find("view-over").addEventListener("change", viewed);
  viewed();
}

function matching(group, sought) {
  if (viewer.hidden.has(group.concept)) return [];
  return group.films.filter((one) => `${group.concept} ${one.label} ${one.flags.join(" ")}`.toLowerCase().includes(sought));
}

function viewed() {
  for (const one of viewer.boxes) {
    if (one.have) fill(one, [], null, () => "");
    if (one.over) dropCanvas(one.over);
  }
  viewer.boxes = [];
  const sought = find("view-text").value.trim().toLowerCase(), over = find("view-over").checked;
  const groups = state.viewer.groups.map((group) => [group, matching(group, sought)]).filter(([, own]) => own.length);
  find("view-films").replaceChildren(...groups.map(([group, own]) => {
    const box = made("div", { className: "films" }), shown = own.map((one) => one.film), view = viewOf(group.films.map((one) => one.film));
    viewer.boxes.push(box);
    if (over) overlay(box, shown, view, group.concept);
    else fill(box, shown, view, (number) => `${group.concept} ${own[number].label}`);
    (box.have || []).forEach((one, number) => one.figure.prepend(made("p", { className: "label", textContent: own[number].label })));
    const flags = own.flatMap((one) => one.flags.map((flag) => made("li", { textContent: `\u26A0 ${one.label}: ${flag}` })));
    return made("section", {}, made("h3", { textContent: `${group.concept}, ${many(own.length, "film")}` }), box, made("ul", { className: "flags" }, ...flags));
  }));
  if (!groups.length) find("view-films").append(made("p", { className: "note", textContent: "Nothing is shown: no film of this choice." }));
  paint();
}

function overlay(box, shown, view, concept) {
  box.over = addCanvas();
  box.classList.add("overlaid");
  box.append(box.over.canvas);
  setCanvas(box.over, shown, view, `All ${shown.length} films of ${concept}, one over another`);
  turnable(box.over.canvas, box.over);
  if (shown.some((film) => film.space)) box.over.canvas.tabIndex = 0;
}
