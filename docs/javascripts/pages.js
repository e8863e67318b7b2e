"use strict";
// What the pages do beside the theme: the copy button takes commands alone, and search works where a page is a file.

// The commands of a console block, without prompts and answers. A command goes on while a quote is open.
function commands(text) {
  const found = [];
  let open = false;
  for (const line of text.split("\n")) {
    if (!open && !line.startsWith("$ ")) continue;
    found.push(open ? line : line.slice(2));
    const command = found.join("\n");
    open = (command.match(/"/g) || []).length % 2 === 1 || line.endsWith("\\");
  }
  return found.join("\n");
}

document.addEventListener("click", event => {
  const button = event.target.closest("[data-clipboard-target]");
  const block = button && document.querySelector(button.dataset.clipboardTarget);
  const text = block && commands(block.textContent);
  if (text) button.dataset.clipboardText = text;
}, true);

// A browser lets no page that is a file fetch the index or start the theme's worker. So the index is a script there.
if (location.protocol === "file:") {
  const base = new URL(JSON.parse(document.getElementById("__config").textContent).base + "/", location);
  const dialog = document.createElement("dialog");
  dialog.className = "file-search";
  dialog.innerHTML = '<input type="search" placeholder="Search" aria-label="Search" autofocus><ol></ol>';
  document.body.append(dialog);
  const [input, list] = dialog.children;

  const plain = html => { const made = new DOMParser().parseFromString(html, "text/html"); return made.body.textContent; };
  function show() {
    const words = input.value.toLowerCase().split(/\s+/).filter(Boolean);
    const found = [];
    for (const one of window.searchIndex ? window.searchIndex.items : []) {
      const title = plain(one.title).toLowerCase(), text = one.text.toLowerCase();
      const marks = words.map(word => title.includes(word) ? 10 : text.includes(word) ? 1 : 0);
      if (words.length && marks.every(Boolean)) found.push([marks.reduce((a, b) => a + b), one]);
    }
    found.sort((a, b) => b[0] - a[0]);
    list.replaceChildren(...found.slice(0, 20).map(([, one]) => {
      const item = document.createElement("li"), link = document.createElement("a"), about = document.createElement("p");
      const text = plain(one.text), at = Math.max(0, text.toLowerCase().indexOf(words[0]) - 60);
      link.href = new URL(one.location, base);
      link.textContent = [...one.path.slice(-1), plain(one.title)].join(" › ");
      about.textContent = text.slice(at, at + 160);
      item.append(link, about);
      return item;
    }));
  }
  function search(event) {
    event.preventDefault();
    event.stopImmediatePropagation();
    if (!dialog.open) dialog.showModal();
    if (window.searchIndex) return;
    const script = document.createElement("script");
    script.src = new URL("search.js", base);
    script.onload = show;
    document.body.append(script);
  }
  input.oninput = show;
  list.onclick = () => dialog.close();
  document.addEventListener("click", event => {
    if (event.target.closest(".md-search__button, [for=__search]")) search(event);
  }, true);
  document.addEventListener("keydown", event => {
    const asks = event.key === "/" && !dialog.open || event.key === "k" && (event.ctrlKey || event.metaKey);
    if (asks) search(event);
  }, true);
}
