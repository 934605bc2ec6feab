// Starts the replay: every module of the page stands in a script of its own, and gets a URL that needs no network.
(async () => {
  const stage = document.getElementById("replay");
  try {
    const imports = {};
    for (const script of document.querySelectorAll("script[data-module]")) {
      imports[script.dataset.module] = URL.createObjectURL(new Blob([script.textContent], { type: "text/javascript" }));
    }
    const map = document.createElement("script");
    map.type = "importmap";
    map.textContent = JSON.stringify({ imports });
    document.head.append(map);
    const { start } = await import(imports["replay/app"]);
    await start(stage);
  } catch (error) {
    stage.querySelector(".replay-trouble").textContent =
      `The 3-D replay cannot run in this browser (${error.message}). The rest of the page needs no script.`;
    stage.classList.add("replay-off");
    console.error(error);
  }
})();
