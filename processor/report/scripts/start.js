// Fills the page's live figures and lets tables be copied. Pictures and tables without this script have the same content.
function start(box, data) {
  box.hidden = false;
  const panel = (title) => {
    const host = make("div", {});
    box.append(make("h3", {}, title), host);
    return host;
  };
  spaceView(panel(`${say(data.title)}${say(", method")} ${data.method}`), data);
  if (data.linear) preassemblyCharts(panel, data);
}

function copying(scroll) { // to paste it into a spreadsheet
  const button = make("button", { type: "button", className: "copy" }, say("copy table"));
  button.addEventListener("click", () => {
    const range = document.createRange(), selection = getSelection();
    range.selectNode(scroll.querySelector("table"));
    selection.removeAllRanges();
    selection.addRange(range);
    document.execCommand("copy");
    selection.removeAllRanges();
    button.textContent = say("copied");
  });
  scroll.before(button);
}

{
  const page = JSON.parse(document.getElementById("live-data").textContent);
  words = page.words;
  for (const scroll of document.querySelectorAll(".scroll")) copying(scroll);
  for (const box of document.querySelectorAll(".live")) start(box, page.steps[box.dataset.step]);
}
