// Rules of ESLint for the page's scripts and their tests.
import js from "@eslint/js";
import globals from "globals";

export default [
  js.configs.recommended,
  { files: ["bevviz/**"], languageOptions: { globals: globals.browser } },
  { files: ["tests/**"], languageOptions: { globals: { ...globals.node, ...globals.browser } } },
];
