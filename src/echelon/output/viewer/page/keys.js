// Keys of a page, and their list, which `?` shows.

const GESTURES = [
  ["drag, wheel, two fingers in the scene", "turn, zoom and move the camera"],
  ["click an agent", "select it"],
  ["wheel or two fingers in a chart", "zoom time; over the numbers at its left the values"],
  ["drag in a zoomed chart", "move the part that is shown"],
  ["double click in a chart", "show all of it"],
];

// Each key has its name, what it does in words, and the action, which is called with the state of shift.
function listenKeys(keys) {
  const named = { " ": "space", ArrowLeft: "\u2190", ArrowRight: "\u2192", Escape: "esc" };
  const table = make("table"), opened = () => document.querySelector("dialog[open]");
  const row = (name, words) => table.append(make("tr", {}, make("th", {}, name), make("td", {}, words)));
  for (const [key, [words]] of Object.entries(keys)) row(named[key] ?? key, words);
  row("?", "this list");
  for (const [name, words] of GESTURES) row(name, words);
  const help = () => (opened() ? opened().close() : showDialog({ id: "help", "aria-label": "keys" }, table));
  $("#keys").addEventListener("click", help);
  addEventListener("keydown", (event) => {
    if (event.target.matches("select, input:not([type=range])") || event.ctrlKey || event.metaKey || event.altKey) return;
    if (event.key === "?") return void help();
    const action = keys[event.key];
    // A slider and a button have keys of their own; the button of a closed list may still have the focus.
    if (!action || opened() || (event.target.matches("input, body button:not(dialog *)") && !/^[a-z]$|Escape/.test(event.key))) return;
    event.preventDefault();
    action[1](event.shiftKey);
  });
}
