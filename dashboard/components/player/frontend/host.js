// The page around the player: Streamlit's component protocol, its theme and its fonts.

let lastHeight = 0;

function post(type, values = {}) {
  window.parent.postMessage({ isStreamlitMessage: true, type: `streamlit:${type}`, ...values }, "*");
}

/** Ask for the trial; `onRender(args, theme)` is called now and after every rerun of the page. */
export function connect(onRender) {
  window.addEventListener("message", (event) => {
    if (event.source === window.parent && event.data?.type === "streamlit:render")
      onRender(event.data.args, event.data.theme ?? {});
  });
  post("componentReady", { apiVersion: 1 });
  new ResizeObserver(fitHeight).observe(document.body);
}

function fitHeight() {
  const height = Math.ceil(document.body.getBoundingClientRect().height);
  if (height !== lastHeight) post("setFrameHeight", { height: (lastHeight = height) });
}

export function send(value) {
  post("setComponentValue", { value, dataType: "json" });
}

/** Take over light or dark, colours and letters of the page. */
export function applyTheme(theme) {
  const root = document.documentElement;
  const dark = (theme.base ?? "light") === "dark";
  root.style.colorScheme = dark ? "dark" : "light";
  root.dataset.mode = dark ? "dark" : "light";
  for (const [name, value] of Object.entries({
    "--back": theme.backgroundColor,
    "--soft": theme.secondaryBackgroundColor,
    "--ink": theme.textColor,
    "--brand": theme.primaryColor,
    "--font": theme.font,
  }))
    if (value) root.style.setProperty(name, value);
}

/** Use the page's own font files; without them the system's letters do. */
export function borrowFonts() {
  const faces = [];
  try {
    for (const sheet of window.parent.document.styleSheets)
      for (const rule of sheet.cssRules)
        if (rule.type === CSSRule.FONT_FACE_RULE && /Source Sans/.test(rule.cssText))
          faces.push(absolute(rule.cssText, sheet.href ?? window.parent.document.baseURI));
  } catch {
    return; // the page is of another origin, or a sheet is closed to scripts
  }
  const style = document.createElement("style");
  style.textContent = faces.join("\n");
  document.head.append(style);
}

function absolute(css, base) {
  return css.replace(/url\(["']?([^"')]+)["']?\)/g, (_, url) => `url("${new URL(url, base)}")`);
}

/** Addresses of Streamlit's media server are those of the page, not of this frame. */
export function mediaAddress(url) {
  const prefix = window.location.pathname.split("/component/")[0];
  return url.startsWith("/") ? prefix + url : url;
}
