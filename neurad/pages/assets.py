"""What pages look like, and how they move: style and script of :func:`neurad.pages.page.page`."""

STYLE = """
:root { --ink: #1a1a1a; --pale: #595959; --line: #d9d9d9; --ground: #fff; --card: #f5f5f5; --bad: #a40000;
        --good: #1b6e2d; --accent: #0b63b5; }
@media (prefers-color-scheme: dark) {
  :root { --ink: #e8e8e8; --pale: #a8a8a8; --line: #3c3c3c; --ground: #161616; --card: #222; --bad: #ff8a80;
          --good: #7fd68f; --accent: #7ab8ff; } }
* { box-sizing: border-box; }
body { font: 15px/1.5 system-ui, "DejaVu Sans", sans-serif; color: var(--ink); background: var(--ground);
       max-width: 1300px; margin: 1.5em auto; padding: 0 1em; }
h1 { font-size: 1.5em; margin: .4em 0; } h2 { font-size: 1.2em; margin: 2em 0 .4em; }
h3 { font-size: 1.05em; margin: 1.6em 0 .4em; } h4 { font-size: 13px; margin: 1em 0 .2em; }
p { margin: .5em 0; max-width: 75em; } .verdict { font-size: 1.12em; }
.warn { color: var(--bad); font-weight: 600; } .note { color: var(--pale); font-size: 13px; }
.scroll { overflow-x: auto; } code { font-size: 13px; overflow-wrap: anywhere; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; font-size: 13px; margin: .5em 0 1em; }
td, th { padding: .25em .55em; text-align: right; vertical-align: bottom; border-bottom: 1px solid var(--line); }
th { font-weight: 600; } .whole { white-space: nowrap; } th:first-child, td:first-child { text-align: left; }
.best { font-weight: 700; } .failed, .beyond { color: var(--bad); } .beyond { font-weight: 600; }
.kept { color: var(--good); font-weight: 600; } .open { font-weight: 600; } .mark { color: var(--pale); }
.row, .sliders, .charts { display: grid; gap: .7em; margin-bottom: .7em;
       --share: calc((100% - 2.9em) / var(--columns, 4));
       grid-template-columns: repeat(auto-fill, minmax(min(100%, max(160px, var(--share))), 1fr)); }
.charts { --columns: 3; }
.sliders { grid-template-columns: repeat(auto-fit, minmax(min(100%, var(--least)), 1fr)); }
figure { margin: 0; min-width: 0; } figcaption { font-size: 13px; line-height: 1.35; padding: .15em 0; }
figcaption, .ends, .meaning { color: var(--pale); } figcaption b { color: var(--ink); }
img { width: 100%; height: auto; display: block; image-rendering: pixelated; }
.tile img { cursor: zoom-in; } .tile img:focus-visible { outline: 3px solid var(--accent); }
.bar { height: 9px; margin-top: 3px; border: 1px solid var(--line); }
.ends { display: flex; justify-content: space-between; font-size: 12px; line-height: 1.3; }
.meaning { text-align: center; font-size: 12px; padding: 0; }
.beside { display: grid; grid-template-columns: 3fr 2fr; gap: .5em; align-items: start; }
.beside:not(:has(.squares)) { grid-template-columns: 1fr; }
.squares { display: grid; grid-template-columns: repeat(var(--across), minmax(0, 1fr)); gap: .3em .5em;
           align-items: end; }
@media (max-width: 560px) { .beside { grid-template-columns: 1fr; } .row figure:empty { display: none; } }
button { font: inherit; font-size: 13px; color: var(--ink); background: var(--card); border: 1px solid var(--line);
         padding: .15em .7em; cursor: pointer; } button + button { border-left: 0; }
button[aria-pressed=true] { background: var(--accent); color: var(--ground); border-color: var(--accent); }
.slider .box { position: relative; --at: 50%; } .slider .over { position: absolute; inset: 0; height: 100%;
       clip-path: inset(0 calc(100% - var(--at)) 0 0); }
.slider .box span { position: absolute; top: 0; bottom: 0; left: var(--at); width: 3px; margin-left: -1.5px;
       background: #fff; box-shadow: 0 0 0 1px #000; pointer-events: none; }
.slider .box span::after { content: "\\2194"; position: absolute; top: 50%; left: 50%; transform: translate(-50%, -50%);
       background: #fff; color: #000; border-radius: 50%; width: 26px; height: 26px; line-height: 25px; font-size: 16px;
       text-align: center; box-shadow: 0 0 0 1px #000; }
.slider input { position: absolute; inset: 0; width: 100%; height: 100%; margin: 0; opacity: 0; cursor: ew-resize; }
.slider .box:focus-within { outline: 3px solid var(--accent); }
dialog { border: 0; padding: 0; background: var(--ground); color: var(--ink); max-width: 98vw; max-height: 98vh; }
dialog::backdrop { background: rgba(0, 0, 0, .75); }
dialog img { width: auto; cursor: zoom-out; } dialog p { margin: .3em .6em; font-size: 14px; }
.chart svg { width: 100%; height: auto; display: block; }
details { margin: .8em 0; } summary { cursor: pointer; color: var(--accent); }
"""

SCRIPT = """
for (const slider of document.querySelectorAll('.slider')) {
  const box = slider.querySelector('.box'), [under, over] = box.querySelectorAll('img');
  const range = box.querySelector('input'), buttons = slider.querySelectorAll('button');
  under.src = document.getElementById(slider.dataset.after).src;
  over.src = document.getElementById(slider.dataset.before).src;
  const move = () => {
    box.style.setProperty('--at', range.value + '%');
    const at = [100, 0].includes(+range.value) ? range.value : '50';
    for (const button of buttons) button.setAttribute('aria-pressed', button.value === at);
  };
  range.addEventListener('input', move);
  for (const button of buttons) button.addEventListener('click', () => { range.value = button.value; move(); });
  move();
}
const dialog = document.createElement('dialog'), large = document.createElement('img');
const words = document.createElement('p');
dialog.append(large, words);
document.body.append(dialog);
const enlarge = picture => {
  large.src = picture.src;
  large.alt = picture.alt;
  words.textContent = picture.alt + ' \\u2014 click or Esc closes';
  const room = Math.min(innerWidth * 0.96 / picture.naturalWidth, (innerHeight * 0.96 - 34) / picture.naturalHeight);
  large.style.width = picture.naturalWidth * (room > 1 ? Math.max(1, Math.floor(room * 2) / 2) : room) + 'px';
  dialog.showModal();
};
for (const picture of document.querySelectorAll('.tile img')) {
  picture.addEventListener('click', () => enlarge(picture));
  picture.addEventListener('keydown', event => {
    if (event.key === 'Enter' || event.key === ' ') { event.preventDefault(); enlarge(picture); }
  });
}
dialog.addEventListener('click', () => dialog.close());
"""
