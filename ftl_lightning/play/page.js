// The page as a whole: what state the program is in, and what is shown of it.
let state = null;

// Shows a state. What is in the mix stays where the model is the same.
async function renew(found) {
  const other = !state || state.model.hash !== found.model.hash;
  state = found;
  document.title = `${state.title}: ftl-lightning play`;
  find("subject").textContent = state.title;
  find("models").replaceChildren(...state.models.map((one) => made("option", { value: one.name, textContent: one.title, selected: one.name === state.model.name })));
  find("models-label").hidden = state.models.length < 2 || Boolean(state.offline || state.viewer);
  find("subject").hidden = !find("models-label").hidden;
  find("loading").hidden = true;
  find("viewer").hidden = !state.viewer;
  find("play-page").hidden = Boolean(state.viewer);
  if (state.viewer) { setViewer(state.viewer); return; }
  setWays();
  if (other) setMix();
  worked(state.work);
  setOffline();
  mixed();
  if (other && !state.offline) await setRecorder(state.recorder);
}

function setOffline() {
  const before = Boolean(state.offline), some = state.work.demonstrations.length > 0;
  for (const id of ["hint", "canvas", "ways", "learning"]) find(id).hidden = before;
  find("made-before").hidden = !before;
  find("showing").hidden = before && !some;
  if (before) {
    find("showing-title").textContent = `${many(state.work.demonstrations.length, "recorded demonstration")}`;
    find("mix-title").textContent = "Mix";
    find("steps").classList.add("one");
  }
}

async function open(name) {
  if (learning.stop) learning.stop.abort();
  await attempt(async () => {
    document.body.setAttribute("aria-busy", "true");
    announce("The model is being loaded.");
    try {
      const found = await ask("/api/open", { model: name });
      Object.assign(learning, { concept: null, task: "", named: false });
      fill(find("samples"), [], null, () => "");
      find("quality").textContent = "";
      find("progress").hidden = find("learned").hidden = true;
      await renew(found);
      announce(`${state.model.title} is opened.`);
    } finally { document.body.removeAttribute("aria-busy"); }
  });
  find("models").value = state.model.name;
}

function theme(dark) {
  document.documentElement.dataset.theme = dark ? "dark" : "light";
  find("theme").setAttribute("aria-label", dark ? "Light page" : "Dark page");
}

async function start() {
  theme(matchMedia("(prefers-color-scheme: dark)").matches);
  find("theme").addEventListener("click", () => theme(document.documentElement.dataset.theme !== "dark"));
  find("models").addEventListener("change", () => open(find("models").value));
  find("error-close").addEventListener("click", () => tellError(""));
  find("end").addEventListener("click", () => attempt(async () => {
    await ask("/api/end", {});
    find("end").replaceWith("The program has ended; you can close this page.");
  }));
  startPlayer();
  listenToHand();
  listenToWork();
  listenToMix();
  await attempt(async () => {
    const packed = find("offline").textContent.trim();
    if (packed) answers = await unpacked(packed);
    await renew(await ask("/api/state"));
  });
  find("loading").hidden = true;
  find("end").hidden = Boolean(answers);
  paint();
  document.body.dataset.ready = Math.round(performance.now()); // milliseconds until the first state is drawn
}

start();
