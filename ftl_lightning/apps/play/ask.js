// Asking the program that serves this page, or, on a page that was made before, looking its answers up.
const GONE = "The program has ended; start it again and reload.";
const token = new URLSearchParams(location.search).get("token") || "";
let answers = null; // by request, where there is no program
let closed = false; // whether a person ended the program: nothing is asked any more, and nothing is a mistake

// The name of a request among answers that were made before.
const requestKey = (path, body) => body === undefined ? path : `${path} ${JSON.stringify(body)}`;

const gone = () => closed ? new DOMException("The program has ended.", "AbortError") : new Error(GONE);

async function request(path, body, signal) {
  if (closed) throw gone();
  const raw = body instanceof Blob;
  const headers = { "X-Token": token };
  if (state && state.model.name) headers["X-Model"] = encodeURIComponent(state.model.name);
  if (body !== undefined) headers["Content-Type"] = raw ? "application/octet-stream" : "application/json";
  let response;
  try {
    response = await fetch(path, { method: body === undefined ? "GET" : "POST", headers, body: raw ? body : JSON.stringify(body), signal });
  } catch (error) {
    throw error.name === "AbortError" ? error : gone();
  }
  if (response.ok) return response;
  let told = "";
  try { told = (await response.json()).error; } catch { /* no JSON: told below */ }
  throw new Error(told || `The program could not answer this (${response.status}).`);
}

async function ask(path, body, signal) {
  if (!answers) return answered(await request(path, body, signal));
  const found = answers[requestKey(path, body)];
  if (found === undefined) throw new Error("This page was made before and has no samples of this choice.");
  return found;
}

async function answered(response) {
  try {
    return await response.json();
  } catch (error) {
    throw error.name === "AbortError" ? error : gone();
  }
}

// The lines of an answer, as they come.
async function* askLines(path, body, signal) {
  const reader = (await request(path, body, signal)).body.getReader(), decoder = new TextDecoder();
  let rest = "";
  for (;;) {
    let read;
    try {
      read = await reader.read();
    } catch (error) {
      throw error.name === "AbortError" ? error : gone();
    }
    rest += read.done ? decoder.decode() : decoder.decode(read.value, { stream: true });
    const lines = rest.split("\n");
    rest = read.done ? "" : lines.pop();
    for (const line of lines) if (line.trim()) yield JSON.parse(line);
    if (read.done) return;
  }
}

async function download(path, name) {
  const response = await request(path);
  const given = response.headers.get("Content-Disposition") || "", found = /filename\*=UTF-8''([^;]+)/.exec(given);
  const address = URL.createObjectURL(await response.blob());
  made("a", { href: address, download: found ? decodeURIComponent(found[1]) : name }).click();
  setTimeout(() => URL.revokeObjectURL(address), 10000);
}

function tellError(text, by = "") {
  find("error").dataset.by = by;
  find("error-text").textContent = text;
  find("error").hidden = !text;
}

// Asks before something is lost; answers whether it is wanted.
function sure(text, yes) {
  const dialog = find("sure");
  find("sure-text").textContent = text;
  find("sure-yes").textContent = yes;
  dialog.returnValue = "";
  dialog.showModal();
  return new Promise((then) => dialog.addEventListener("close", () => then(dialog.returnValue === "yes"), { once: true }));
}

// Errors are told, and never break the page; what was given up for something newer is none. What a person does next takes
// the message away, what the page does `by` itself only its own.
async function attempt(what, by = "") {
  try {
    const found = await what();
    if (!by || by === find("error").dataset.by) tellError("");
    return found;
  } catch (error) {
    if (error.name !== "AbortError") tellError(error.message || String(error), by);
    return undefined;
  }
}
