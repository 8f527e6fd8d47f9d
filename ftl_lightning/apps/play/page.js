// The page as a whole: what state the program is in, and what is shown of it.
let state = null;
let opening = false; // whether another model is on its way

// Shows a state. What is in the mix stays where the model is the same.
async function renew(found, anew = false) {
  const other = anew || !state || state.model.hash !== found.model.hash;
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
  if (learning.concept && !conceptOf(learning.concept.id)) noConcept();
  worked(state.work);
  setOffline();
  mixed();
  if (other && !state.offline) await setRecorder(state.recorder);
}

function setOffline() {
  const before = Boolean(state.offline), some = state.work.demonstrations.length > 0;
  for (const id of ["hint", "canvas", "edit", "ways", "learning"]) find(id).hidden = before;
  find("made-before").hidden = !before;
  find("showing").hidden = before && !some;
  if (before) {
    find("showing-title").textContent = `${many(state.work.demonstrations.length, "recorded demonstration")}`;
    find("mix-title").textContent = "Mix";
    find("steps").classList.add("bare", "one");
  }
}

async function open(name) {
  const { title } = state.models.find((one) => one.name === name);
  if (learning.stop && !await sure(`Learning is not finished. Stop it and open ${title}?`, "Stop and open")) {
    find("models").value = state.model.name;
    return;
  }
  if (learning.stop) learning.stop.abort();
  const before = { model: state.model.name, parts: mix.parts };
  await attempt(async () => {
    leave(`The model ${title} is being opened \u2026`);
    try {
      const found = await ask("/api/open", { model: name });
      arrive();
      await renew(found, true);
      announce(`${title} is opened.`);
    } catch (error) {
      const found = await ask("/api/state");
      arrive();
      await renew(found, true);
      if (found.model.name === before.model) { mix.parts = before.parts; mixed(); }
      throw error;
    } finally { arrive(); }
  });
  find("models").value = state.model.name;
}

// Takes away what is of the model that is left, as long as another one is opened. Nothing moves: what was there keeps its height.
function leave(text) {
  for (const id of ["steps", "mixing"]) find(id).style.minHeight = `${find(id).offsetHeight}px`;
  opening = true;
  document.body.setAttribute("aria-busy", "true");
  find("play-page").inert = find("models").disabled = true;
  find("opening").textContent = text;
  find("opening").hidden = false;
  announce(text);
  noQuestions();
  noConcept();
  noSamples();
  noScene();
  Object.assign(learning, { task: "", named: false });
  worked({ ...state.work, demonstrations: [], check: [], undo: false, same: { python: "", command: "" } });
  find("name").value = find("waiting").textContent = "";
  find("mix").replaceChildren();
}

function arrive() {
  opening = false;
  document.body.removeAttribute("aria-busy");
  find("play-page").inert = find("models").disabled = false;
  find("opening").hidden = true;
}

// The heights that were kept go once the samples are there.
function settled() {
  if (!opening) for (const id of ["steps", "mixing"]) find(id).style.minHeight = "";
}

async function end() {
  const lost = [...learning.unsaved.values()].map((name) => `\u201c${name}\u201d`);
  const why = learning.stop ? "Learning is not finished." : lost.length ? `${lost.join(", ")} ${lost.length === 1 ? "is" : "are"} not saved.` : "";
  if (why && !await sure(`${why} End the program all the same?`, "End the program")) return;
  if (learning.stop) learning.stop.abort();
  if (learning.again) learning.again.abort();
  noQuestions();
  await attempt(async () => {
    await ask("/api/end", {});
    closed = true;
    noQuestions();
    tellError("");
    for (const one of document.querySelectorAll("main > *")) one.hidden = one.id !== "ended";
    find("models-label").hidden = true;
    films.clear();
    player.changed = true;
    announce(find("ended").textContent);
  });
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
  find("end").addEventListener("click", end);
  for (const id of ["sure-yes", "sure-no"]) find(id).addEventListener("click", () => find("sure").close(id === "sure-yes" ? "yes" : ""));
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
  if (!answers && state && !state.viewer) playExample();
  document.body.dataset.ready = Math.round(performance.now()); // milliseconds until the first state is drawn
}

start();
