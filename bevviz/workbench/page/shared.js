// The browser sends the cookie of the workbench with this navigation, but not with one from a mail or a chat.
location.replace(`/${location.hash}`);
