// What axe misses in the theme's pages: keys that scroll, and roles.
for (const wide of document.querySelectorAll("pre code, table.docutils")) wide.tabIndex = 0;
for (const head of document.querySelectorAll("th:empty")) head.replaceWith(document.createElement("td"));
for (const inner of document.querySelectorAll("footer [role]")) inner.removeAttribute("role");
document.querySelector("footer")?.setAttribute("role", "contentinfo");
document.querySelector(".rst-versions")?.setAttribute("role", "region");

for (const block of document.querySelectorAll("pre")) {
  const [button, text] = [document.createElement("button"), block.textContent];
  button.textContent = "Copy";
  button.onclick = () => navigator.clipboard.writeText(text).then(() => (button.textContent = "Copied"));
  block.append(button);
}

// From disk, browsers start no worker and read no JSON. There, search runs in the page; the index is a script.
if (location.protocol === "file:") {
  const load = (name) =>
    new Promise((resolve) => {
      const script = document.createElement("script");
      script.src = `${base_url}/search/${name}`;
      script.onload = resolve;
      document.head.append(script);
    });

  window.Worker = class {
    async postMessage({ init, query }) {
      if (init) {
        await Promise.all([load("lunr.js"), load("search_index.js")]);
        this.pages = new Map(searchIndex.docs.map((page) => [page.location, page]));
        this.index = lunr((builder) => {
          builder.ref("location");
          builder.field("title");
          builder.field("text");
          searchIndex.docs.forEach((page) => builder.add(page));
        });
        this.onmessage({ data: { config: searchIndex.config } });
        this.onmessage({ data: { allowSearch: true } });
      } else {
        const found = this.index.search(query).map(({ ref }) => this.pages.get(ref));
        const results = found.map((page) => ({ ...page, summary: page.text.slice(0, 200) }));
        this.onmessage({ data: { results } });
      }
    }
  };
}
