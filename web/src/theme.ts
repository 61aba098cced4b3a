/** Light or dark: as the system says, or as was chosen here. */

import { el } from "./dom";

const STORED = "shrinkd.theme";
const THEMES = [["", "System"], ["light", "Light"], ["dark", "Dark"]] as const;

export function themeSelect(): HTMLElement {
  const chosen = localStorage.getItem(STORED) ?? "";
  apply(chosen);
  const select = el(
    "select",
    {
      id: "theme",
      onchange: () => {
        localStorage.setItem(STORED, select.value);
        apply(select.value);
      },
    },
    ...THEMES.map(([value, name]) => el("option", { value, selected: value === chosen }, name)),
  );
  return el("label", { class: "theme" }, el("span", { class: "sr" }, "Colours"), select);
}

function apply(theme: string): void {
  if (theme) document.documentElement.dataset.theme = theme;
  else delete document.documentElement.dataset.theme;
}
